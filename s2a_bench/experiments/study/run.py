"""Studies of the policies: cells of drawn plans, one after another or on several cores, each with its own seed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.experiments.study.config import Cell, StudyConfig
from s2a_bench.experiments.study.rows import STUDY_CELLS, StudyRow
from s2a_bench.machine import environment
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


def run_study(config: StudyConfig, output: Path, progress: Progress) -> Path:
    """Run a study and return its run folder; rows are kept cell by cell."""
    cells = config.cells
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"study": config.seed},
        "provenance": Origins(Provenance.computed()).to_manifest(),
        "warnings": [warning.to_manifest() for warning in config.warnings()],
    }
    with RunWriter.create(output, f"study-{config.name}", manifest, (STUDY_CELLS,)) as writer:
        progress.opened(writer.path)
        progress.stage(f"study {config.name}")
        progress.expect(len(cells))
        for rows in results(cells, config.jobs):
            writer.append(STUDY_CELLS, rows)
            progress.advance()
        return writer.path


def results(cells: Sequence[Cell], jobs: int = 1) -> Iterator[Sequence[StudyRow]]:
    """Yield each cell's rows in the cells' order, whatever the number of processes."""
    if jobs == 1:
        yield from (cell() for cell in cells)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_call, cells)


def _call(cell: Cell) -> Sequence[StudyRow]:
    return cell()
