"""What `toy-clock` is asked, the rows that it keeps, and how it measures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from s2a_bench.clock import now_ns
from s2a_bench.experiments.cells import Metric
from s2a_bench.machine import environment
from s2a_bench.options import Options, option
from s2a_bench.progress import Progress
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import Table


class ClockConfig(Options):
    """How the clock is read."""

    readings: int = option(1000, "how often the clock is read", ge=1, le=1_000_000)


@dataclass(frozen=True, slots=True)
class ReadingRow:
    """One pair of readings; the annotation of a column makes it a metric."""

    cell: str
    cost: Annotated[float, Metric("cost of a reading", unit="ns")]


READINGS: Table[ReadingRow] = Table("readings", ReadingRow)


def run_clock(config: ClockConfig, output: Path, progress: Progress) -> Path:
    """Read the clock twice in a row, as often as asked; return the run folder."""
    manifest = {"configuration": config.to_manifest(), "environment": environment.collect()}
    with RunWriter.create(output, "toy-clock", manifest, (READINGS,)) as writer:
        progress.opened(writer.path)
        progress.stage("reading the clock")
        writer.append(READINGS, [ReadingRow("monotonic", float(-now_ns() + now_ns())) for _ in range(config.readings)])
        return writer.path
