"""The tables of a run laid out for a terminal of 100 columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import cells_of
from s2a_bench.experiments.latency.view.frame_path import frame_table
from s2a_bench.experiments.latency.view.tables import group_table, stage_table, summary_table, token_table
from s2a_bench.writers.terminal import lay_out

if TYPE_CHECKING:
    from rich.console import RenderableType

    from s2a_bench.store.run import Run

_FULL_CELLS = 2
"""As many cells leave room for mean ± sd beside the medians."""
_STAGE_CELLS = 5
"""With more cells than these the cells become rows."""


def renderables(run: Run) -> list[RenderableType]:
    """Return what a latency run prints: the stages, then what is compared; end to end too where a model answers."""
    cells = cells_of(run)
    stages = group_table(run) if len(cells) > _STAGE_CELLS else stage_table(run, full=len(cells) <= _FULL_CELLS)
    shown = [stages]
    if any(cell.values_ms("e2e_without_inference").size for cell in cells):
        shown.append(summary_table(run))
    if any(cell.about["engine"] != "echo" or not cell.values_ms("e2e_without_inference").size for cell in cells):
        shown.append(summary_table(run, "e2e"))
    if tokens := token_table(run):
        shown.append(tokens)
    if frames := frame_table(run):
        shown.append(frames)
    return [*(lay_out(table) for table in shown), " ".join(stages.notes)]
