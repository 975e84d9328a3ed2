"""The ``--json`` object of a throughput run: rates in tokens/s, times in ms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from s2a_bench.experiments.latency.view.as_json import about_cell
from s2a_bench.experiments.throughput.view.cell import Position, Reference, ThroughputCell
from s2a_bench.experiments.throughput.view.cells import (
    LLAMA_BENCH,
    METRICS,
    RATIO_METRIC,
    Speed,
    every_ratio_of,
    reference_depths,
    reference_values,
    speeds_of,
)
from s2a_bench.store.manifest import present
from s2a_bench.writers.as_json import frame, ratio_entry, summaries

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def throughput_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints; strict JSON, as docs/schema/s2a-bench-1.json describes it."""
    speeds = speeds_of(run)
    ratios = [ratio_entry(*found) for found in every_ratio_of(run, speeds)]
    more = {"reference": _reference(run)} if reference_values(run) else {}
    return frame(run, [_cell(speed, run) for speed in speeds], ratios, **more)


def _cell(speed: Speed, run: Run) -> dict[str, Any]:
    """Return one cell's numbers; a metric that no request has is an absent key."""
    metrics = [*((metric, speed.values(metric)) for metric in METRICS), ("itl_ms", speed.cell.itl_ms())]
    return present(
        ThroughputCell(
            **about_cell(speed.cell, run),
            t_eval="engine" if speed.told else "client",
            **summaries(metrics),
            positions=[
                Position(first, last, **summaries([(RATIO_METRIC, rates)]))
                for (first, last), rates in speed.by_position().items()
            ],
        )
    )


def _reference(run: Run) -> dict[str, Any]:
    """Return what llama-bench said, beside the command that was run."""
    return present(
        Reference(
            LLAMA_BENCH,
            run.manifest.get("reference", {}).get("command", []),
            reference_depths(run),
            **summaries([(RATIO_METRIC, np.asarray(reference_values(run)))]),
        )
    )
