"""The frame path of a stream-mode run: from the camera's tick to where the prompt finds the frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.experiments.latency.view.cells import Cell, cells_of, numbers_ms
from s2a_bench.stats import summary_of
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.store.run import Run

_FOOT = {
    "residual": "residual",
    "path": "frame path",
    "latency": "frame path from the intended time",
}


def frame_table(run: Run) -> TextTable | None:
    """Lay out the budget of the frames that a prompt was about: medians in ms, a column a cell; None without frames.

    The last row is the age of the frame when inference starts, from the samples.
    """
    if run.frames.empty:
        return None
    cells = cells_of(run)
    used = [_used(run, cell) for cell in cells]
    rows = []
    for stage, group in run.stages.items():
        values = [frames[stage] for frames in used]
        if any(found.size for found in values):
            rows.append((group, stage, *(_median(found) for found in values)))
    rule = len(rows)
    rows += [("", name, *(_median(frames[column]) for frames in used)) for column, name in _FOOT.items()]
    rows.append(("", "age when inference starts", *(_median(cell.values_ms("frame_age")) for cell in cells)))
    return TextTable(
        "Frame path in ms: medians over the frames that a prompt was about",
        ("group", "stage", *(cell.name for cell in cells)),
        rows,
        2,
        frozenset({rule + 1}),
    )


def _used(run: Run, cell: Cell) -> dict[str, Floats]:
    """Return the columns, in ms, of the frames that a counted sample of this cell used."""
    frames = run.frames[run.frames["used_by"].isin(cell.good["request_id"])]
    return {name: numbers_ms(frames[f"{name}_ns"]) for name in (*run.stages, *_FOOT)}


def _median(values: Floats) -> str:
    summary = summary_of(values)
    return number(summary.median) if summary else ABSENT
