"""How a CCRB run is shown: its tables, figures, animation and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def show(run: Run, *, animation: bool = False, **_: Any) -> Shown:
    """Return what a CCRB run shows; the animation where it is asked for."""
    from s2a_bench.experiments.ccrb.view.animation import animation_files
    from s2a_bench.experiments.ccrb.view.figures import ccrb_figures
    from s2a_bench.experiments.ccrb.view.sentences import ccrb_notes, ccrb_sentences
    from s2a_bench.experiments.ccrb.view.tables import ccrb_csv, ccrb_json, ccrb_tables

    tables = ccrb_tables(run)
    return Shown(
        sentences=ccrb_sentences(run),
        tables=tables,
        main=[name for name in ("outcomes", "phase", "random", "followers", "follower-shares") if name in tables],
        notes=[*dict.fromkeys(note for table in tables.values() for note in table.notes), *ccrb_notes(run)],
        csvs=ccrb_csv(run),
        figures=ccrb_figures(run),
        files=animation_files(run) if animation else {},
        json=lambda: ccrb_json(run),
    )
