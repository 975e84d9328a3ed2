"""The machine's view of a run: the ``--json`` object of every measuring command; times in ms, for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.latency.view.cell import LatencyCell
from s2a_bench.experiments.latency.view.cells import (
    Cell,
    asked,
    cells_of,
    groups_present,
    pieces_of,
    ratios,
    stages_present,
)
from s2a_bench.store.manifest import present
from s2a_bench.writers.as_json import frame, ratio_entry, summaries

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def latency_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints; strict JSON, as docs/schema/s2a-bench-1.json describes it."""
    cells = cells_of(run)
    found = ratios(cells, run.bootstrap_seed)
    return frame(
        run,
        [_cell(cell, run) for cell in cells],
        [ratio_entry(f"{metric}_ms", cell.name, base.name, ratio) for metric, cell, base, ratio in found],
    )


def about_cell(cell: Cell, run: Run) -> dict[str, Any]:
    """Return what the cells of all commands say about themselves; ``dummy`` where it is known."""
    origin = run.origins.of(cell.name)
    return {
        "cell": cell.name,
        **cell.about,
        "observation": asked(run, [cell]),
        "answer": pieces_of(run),
        "profile": origin.profile or None,
        "emulated": cell.emulated,
        "dummy": {"real": False, "dummy": True, "none": True}.get(origin.weights),
        "n": cell.n,
        "errors": cell.errors,
        "warmups": cell.warmups,
    }


def _cell(cell: Cell, run: Run) -> dict[str, Any]:
    """Return one cell's numbers; a metric that no sample has is an absent key."""
    metrics = ("e2e", "e2e_without_inference", "e2e_without_model", "ttft", "frame_age")
    numbers = [
        *((f"{metric}_ms", cell.values_ms(metric)) for metric in metrics),
        ("itl_ms", cell.itl_ms()),
        ("token_delay_ms", cell.token_delay_ms()),
        ("residual_share", cell.residual_shares()),
    ]
    return present(
        LatencyCell(
            **about_cell(cell, run),
            residual_flagged=cell.flagged(),
            stages_ms=summaries((stage, cell.values_ms(stage)) for stage in stages_present([cell])),
            groups_ms=summaries((group, cell.group_ms(group)) for group in groups_present([cell])),
            **summaries(numbers),
        )
    )
