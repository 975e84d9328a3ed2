"""The studies there are: what each varies, and what computes, lays out and draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_HERE: Final = __package__


@dataclass(frozen=True, slots=True)
class Study:
    """The declaration of one study; what it names as ``module:attribute`` is imported when it is needed."""

    name: str
    about: str
    cells: str
    """Function ``(config) -> cells``, its independent pieces of work."""
    tables: str
    """Function ``(rows) -> tables``."""
    figure: str
    """Function ``(run) -> figure``."""
    targets: str = ""
    """Function ``(rows) -> targets``, for a study that has limits to keep."""


_ALL: Final = (
    Study(
        "targets",
        "what stream-to-act must reach",
        cells=f"{_HERE}.targets:cells",
        tables=f"{_HERE}.view.tables:target_tables",
        figure=f"{_HERE}.view.figures:build_targets",
        targets=f"{_HERE}.view.targets:targets_of",
    ),
    Study(
        "frontier",
        "stalls against regret",
        cells=f"{_HERE}.jitter:cells",
        tables=f"{_HERE}.view.tables:frontier_tables",
        figure=f"{_HERE}.view.figures:build_frontier",
    ),
    Study(
        "drift",
        "tracking lambda",
        cells=f"{_HERE}.drift:cells",
        tables=f"{_HERE}.view.tables:drift_tables",
        figure=f"{_HERE}.view.figures:build_drift",
    ),
    Study(
        "shift",
        "plans unlike those of the calibration",
        cells=f"{_HERE}.shift:cells",
        tables=f"{_HERE}.view.rules:shift_tables",
        figure=f"{_HERE}.view.rules:build_shift",
    ),
    Study(
        "split",
        "stretching spent on an early start or kept",
        cells=f"{_HERE}.split:cells",
        tables=f"{_HERE}.view.rules:split_tables",
        figure=f"{_HERE}.view.rules:build_split",
    ),
    Study(
        "misfit",
        "wrong N, L, rate",
        cells=f"{_HERE}.misfit:cells",
        tables=f"{_HERE}.view.tables:misfit_tables",
        figure=f"{_HERE}.view.figures:build_misfit",
    ),
)
STUDIES: Final = {study.name: study for study in _ALL}
"""The studies by their names."""
