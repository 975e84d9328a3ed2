"""How a boundary run is shown: its tables, figure and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def show(run: Run, **_: Any) -> Shown:
    """Return what a boundary run shows."""
    from s2a_bench.experiments.boundary.view.figure import boundary_figures
    from s2a_bench.experiments.boundary.view.tables import (
        boundary_csv,
        boundary_json,
        boundary_sentences,
        boundary_tables,
    )

    tables = boundary_tables(run)
    return Shown(
        sentences=boundary_sentences(run),
        tables=tables,
        main=["boards"],
        notes=tables["boards"].notes,
        csvs=boundary_csv(run),
        figures=boundary_figures(run),
        json=lambda: boundary_json(run),
    )
