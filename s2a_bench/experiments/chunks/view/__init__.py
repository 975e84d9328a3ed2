"""How a run of chunks is shown: its tables, figures, sentences and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def show(run: Run, **_: Any) -> Shown:
    """Return what a run of chunks shows."""
    from s2a_bench.experiments.chunks.view.figures import chunk_figures
    from s2a_bench.experiments.chunks.view.lanes import lanes_of
    from s2a_bench.experiments.chunks.view.tables import chunk_csv, chunk_json, chunk_sentences, chunk_tables

    tables = chunk_tables(run)
    main = [name for name in ("chunks", "loop") if name in tables]
    return Shown(
        sentences=chunk_sentences(run),
        tables=tables,
        main=main,
        notes=list(dict.fromkeys(note for name in main for note in tables[name].notes)),
        csvs=chunk_csv(run),
        figures=chunk_figures(run),
        json=lambda: chunk_json(run),
        lanes=lanes_of(run),
    )
