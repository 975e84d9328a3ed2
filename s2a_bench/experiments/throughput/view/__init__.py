"""How a throughput run is shown: its tables, figures, sentences and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown

if TYPE_CHECKING:
    from s2a_bench.store.run import Run


def show(run: Run, *, against: str = "", **_: Any) -> Shown:
    """Return what a throughput run shows."""
    from s2a_bench.experiments.throughput.view.as_json import throughput_json
    from s2a_bench.experiments.throughput.view.figures import throughput_figures
    from s2a_bench.experiments.throughput.view.sentences import throughput_sentences
    from s2a_bench.experiments.throughput.view.tables import throughput_csv, throughput_tables

    tables = throughput_tables(run)
    return Shown(
        sentences=throughput_sentences(run),
        tables=tables,
        main=["throughput", "prompt"],
        notes=[" ".join(tables["throughput"].notes)],
        csvs=throughput_csv(run),
        figures=throughput_figures(run, against_paper=against == "paper"),
        json=lambda: throughput_json(run),
    )
