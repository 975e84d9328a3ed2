"""What timeline runs are compared by: the times and the numbers of every plan."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments import Compared, Metric, Subject, by_name
from s2a_bench.experiments.timeline.view.cells import NUMBERS, TIMES, Timelines, origin_notes, timelines_of

if TYPE_CHECKING:
    from s2a_bench.experiments import Rows
    from s2a_bench.store.run import Run

_SETTING: Final = (
    "policy",
    "board",
    "tokens_per_s",
    "prompt_s",
    "tokens_per_skill",
    "n_skills",
    "t_nom_s",
    "mode",
    "emulated",
)
_MAY_BE_ZERO: Final = frozenset({"stall", "longest_stall", "mean_queue_wait", "longest_queue_wait"})
_HIGHER: Final = frozenset({"fluidity", "sparc"})
_TIMES_S: Final = frozenset(f"{name}_s" for name in TIMES)
_ANY_STALL: Final = "p_any_stall"


def _subjects(run: Run) -> list[Subject]:
    asked = run.manifest.get("configuration", {})
    even = asked.get("jitter") == "none" and not asked.get("t_nom_cv")
    return [
        Subject(
            str(cell.about("cell")),
            {name: str(cell.about(name)) for name in _SETTING},
            cell.n,
            0,
            partial(_rows, cell),
            exact=even and cell.about("mode") == "virtual",
        )
        for cell in timelines_of(run)
    ]


def _rows(cell: Timelines, name: str) -> Rows:
    """Return a metric, a row a plan; times lose their unit to find their column."""
    if name == _ANY_STALL:
        values = cell.rows["any_stall"].to_numpy(dtype="float64")
    else:
        values = cell.values(name.removesuffix("_s") if name in _TIMES_S else name)
    return list(values[:, None])


def _origin(run: Run) -> tuple[str, ...]:
    return origin_notes(run, timelines_of(run))


COMPARED: Final = Compared(
    metrics=by_name(
        [
            *(Metric(f"{name}_s", "s", statistic="mean" if name in _MAY_BE_ZERO else "median") for name in TIMES),
            *(Metric(name, "", "higher" if name in _HIGHER else "lower", statistic="mean") for name in NUMBERS),
            Metric(_ANY_STALL, "", statistic="mean"),
        ]
    ),
    subjects=_subjects,
    origin=_origin,
    shown=("start_s", "end_s", "stall_s", "stalls", "start_regret", "end_regret"),
)
