"""What latency runs are compared by: times of a request, its stages and groups, and what its tokens show."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.experiments import Compared, Metric, Subject, by_name
from s2a_bench.experiments.latency.view.cells import Cell, launches_of, numbers_ms, split, stand_ins
from s2a_bench.trace import GROUPS

if TYPE_CHECKING:
    from s2a_bench.experiments import Rows
    from s2a_bench.experiments.latency.view.cells import Floats
    from s2a_bench.store.run import Run

TOKEN_METRICS: Final = (Metric("itl", "ms"), Metric("token_delay", "ms"))
"""What the tokens of a request show, so that a row has several values."""


def subject_of(cell: Cell, rows: Callable[[str], Rows], launch: int) -> Subject:
    """Return a cell of requests in one launch as it is compared."""
    return Subject(cell.name, cell.about, cell.n, cell.errors, rows, launch=launch)


def origin_of(run: Run) -> list[str]:
    """Return what did not really answer the requests of a run."""
    return stand_ins(split([run]))


def token_rows(cell: Cell, name: str) -> Rows | None:
    """Return the rows of one of `TOKEN_METRICS`, else None."""
    return _per_request(cell, _TOKEN_COLUMNS[name]) if name in _TOKEN_COLUMNS else None


def singles(values: Floats) -> Rows:
    """Make each value a row."""
    return list(values[:, None])


def _subjects(run: Run) -> list[Subject]:
    return [subject_of(cell, partial(_rows, cell), launch) for launch, cells in launches_of(run) for cell in cells]


def _rows(cell: Cell, name: str) -> Rows:
    """Return the rows of a stage, a group, a column or the gaps between tokens."""
    if (found := token_rows(cell, name)) is not None:
        return found
    if name.startswith(_GROUP):
        return singles(cell.group_ms(name.removeprefix(_GROUP)))
    return singles(cell.values_ms(name))


def _per_request(cell: Cell, column: str) -> Rows:
    """Return a time of each request's tokens in ms, a row a request that has any."""
    tokens = cell.answers.groupby("request_id", sort=False)[column]
    found = {str(request): numbers_ms(values) for request, values in tokens}
    return [found[request] for request in cell.good["request_id"] if found.get(request, _NOTHING).size]


_TOKEN_COLUMNS: Final = {"itl": "gap_ns", "token_delay": "delay_ns"}
_NOTHING: Final = np.empty(0)
_GROUP: Final = "group."

COMPARED: Final = Compared(
    metrics=by_name(
        [
            *(
                Metric(name, "ms")
                for name in ("e2e_without_inference", "e2e_without_model", "e2e", "ttft", "frame_age")
            ),
            *TOKEN_METRICS,
            Metric("residual", "ms"),
            *(Metric(f"{_GROUP}{name}", "ms") for name in GROUPS),
        ]
    ),
    subjects=_subjects,
    origin=origin_of,
    shown=("e2e_without_inference", "e2e", "itl"),
    own=lambda run: [Metric(stage, "ms") for stage in run.stages],
)
