"""How timelines are shown: tables, figures, trace and JSON, the same however they were run."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown
from s2a_bench.options import Options, option

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


class Asked(Options):
    """What is printed."""

    per_skill: bool = option(False, "also print every skill of the shown plans")


def show(run: Run, *, per_skill: bool = False, **_: Any) -> Shown:
    """Return what a run of timelines shows; ``per_skill`` also prints the skills of several settings."""
    from s2a_bench.experiments.timeline.view.as_json import timelines_json
    from s2a_bench.experiments.timeline.view.cells import timelines_of
    from s2a_bench.experiments.timeline.view.chrome_trace import TRACE, write_trace
    from s2a_bench.experiments.timeline.view.figures import timeline_figures
    from s2a_bench.experiments.timeline.view.sentences import timeline_sentences
    from s2a_bench.experiments.timeline.view.tables import timeline_csv, timeline_tables

    cells = timelines_of(run)
    tables = timeline_tables(run)
    one_setting = len({cell.setting for cell in cells}) == 1
    return Shown(
        sentences=timeline_sentences(run),
        tables=tables,
        main=["timelines"],
        printed=[name for name in tables if name != "skills" or per_skill or one_setting],
        notes=tables["timelines"].notes,
        csvs=timeline_csv(run),
        figures=timeline_figures(run),
        files={TRACE: partial(write_trace, run)},
        json=lambda: timelines_json(run),
        lanes=[cell for cell in cells if len(cell.skills)],
    )
