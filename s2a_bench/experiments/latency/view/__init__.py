"""How a latency run is shown: tables, figures, sentences and JSON, and what of them a terminal has room for."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments import Shown

if TYPE_CHECKING:
    from collections.abc import Iterator

    from s2a_bench.store.run import Run

_FULL_CELLS = 2
"""As many cells leave room for mean ± sd beside the medians."""
_SUMMARY_COLUMNS = 9
"""With more columns than these, ratios to more than two cells, the spread is told in short."""
_STAGE_CELLS = 5
"""With more cells than these the cells become rows."""


def show(run: Run, *, against: str = "", verbose: bool = False, **_: Any) -> Shown:
    """Return what a latency run shows."""
    from s2a_bench.experiments.latency.view.as_csv import csv_texts
    from s2a_bench.experiments.latency.view.as_json import latency_json
    from s2a_bench.experiments.latency.view.cells import cells_of
    from s2a_bench.experiments.latency.view.figures import latency_figures
    from s2a_bench.experiments.latency.view.sentences import latency_sentences
    from s2a_bench.experiments.latency.view.tables import group_table, latency_tables, stage_table, summary_table

    n = len(cells_of(run))
    tables = latency_tables(run)
    stages = group_table(run) if n > _STAGE_CELLS else stage_table(run, full=n <= _FULL_CELLS)
    printed = _printed(run)
    compared = tables["summary" if "summary" in printed else "summary-e2e"]
    narrow = {"stages": stages}
    for name, metric in (("summary", "e2e_without_inference"), ("summary-e2e", "e2e")):
        if len(tables[name].header) > _SUMMARY_COLUMNS:
            narrow[name] = summary_table(run, metric, brief=True)
    return Shown(
        sentences=latency_sentences(run),
        tables=tables,
        main=[name for name in ("summary", "summary-model", "stages") if name in tables],
        printed=[name for name in tables if name in printed],
        narrow=narrow,
        notes=[" ".join(dict.fromkeys((*stages.notes, *compared.notes))), *(_verbose(run) if verbose else ())],
        csvs=csv_texts(run),
        figures=latency_figures(run, against_paper=against == "paper"),
        json=lambda: latency_json(run),
    )


def _printed(run: Run) -> set[str]:
    """Return the tables for the terminal: the stages, and what is compared; end to end too where a model answers.

    Without model is printed where a llama-server stands beside our own, which it alone can be compared with.
    """
    from s2a_bench.experiments.latency.view.cells import cells_of

    cells = cells_of(run)
    known = [bool(cell.values_ms("e2e_without_inference").size) for cell in cells]
    names = {"stages", "tokens", "frames"}
    if any(known):
        names.add("summary")
    if not all(known) or any(cell.about["engine"] != "echo" for cell in cells):
        names.add("summary-e2e")
    if any(cell.has_ingest for cell in cells):
        names.add("summary-model")
    return names


def _verbose(run: Run) -> Iterator[str]:
    """Yield what measuring costs, and the environment."""
    yield f"a mark costs {run.manifest['mark_cost_ns']} ns"
    if sampled := run.manifest.get("resources"):
        share, edge_us = sampled["core_share"] or 0, sampled["edge_us"]
        yield f"sampling takes {share:.2%} of a core, and {edge_us} us before and after each request"
    yield from json.dumps(run.manifest["environment"], indent=2, ensure_ascii=False).splitlines()
