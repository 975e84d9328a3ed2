"""What runs of timelines are compared by: their metrics, a row a plan."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments import Compared, Subject
from s2a_bench.experiments.timeline.metrics import METRICS
from s2a_bench.experiments.timeline.view.cells import Timelines, origin_notes, timelines_of

if TYPE_CHECKING:
    from s2a_bench.experiments.latency.view.cells import Floats
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


def _subjects(run: Run) -> list[Subject]:
    """Return the cells of a run."""
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


def _rows(cell: Timelines, metric: str) -> list[Floats]:
    return list(cell.values(metric)[:, None])


COMPARED: Final = Compared(
    metrics=METRICS,
    subjects=_subjects,
    origin=lambda run: origin_notes(run, timelines_of(run)),
    shown=("start_s", "end_s", "stall_s", "stalls", "start_regret", "end_regret"),
)
