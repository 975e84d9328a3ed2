"""The views of a sweep: an overview of its cells, and computed timelines combined into one run.

Measured cells stay separate runs, since machines and moments differ.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

from s2a_bench.experiments import Shown, Tables
from s2a_bench.experiments.latency.view import against_bytes
from s2a_bench.experiments.requests import RequestCell, Split, metric_phrase, split, stand_ins
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.policy import Floats
from s2a_bench.provenance import Origins
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import StoredRun
from s2a_bench.store.sweep import Sweep
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import marked
from s2a_bench.writers.tables import MEAN_SD, TextTable, entries

Runs = Sequence[tuple[dict[str, Any], StoredRun]]

_AXES: Final = ("policies", "profiles", "rates", "tokens_per_skill", "n_skills", "t_nom_s")
"""Options that may differ between combined timelines; they are in the name of a timeline's cell."""


def overview(sweep: Sweep, runs: Runs) -> Shown:
    """Return the states of a sweep's cells, and the numbers of the measured ones side by side."""
    states = sweep.cells["state"].value_counts().to_dict()
    planned = int(sweep.manifest["configuration"].get("cells", len(sweep.cells)))
    done = int(states.get("finished", 0))
    sentences = [f"{done} of {planned} cells of s2a-bench {sweep.manifest['configuration']['command']} are finished."]
    if failed := int(states.get("failed", 0)):
        sentences.append(
            f"{failed} failed; the table of cells has the errors, --resume --retry-failed runs them again."
        )
    cells = split(run for _, run in runs)
    lines, figures = against_bytes.shown(cells)
    measured = partial(measured_table, [settings for settings, _ in runs], cells)
    builders: Tables = {**lines, "overview": measured, "cells": partial(cell_table, sweep)}
    shown = Shown.build(builders, [*lines, "overview"], csvs=lambda: {"cells.csv": CsvTable.of_frame(sweep.cells)})
    line = sweep.origins.line
    tables = {name: replace(table, provenance=line) for name, table in shown.tables.items()}
    drawn = {name: partial(marked, build, *(run for _, run in runs)) for name, build in figures.items()}
    return replace(shown, sentences=sentences, tables=tables, figures=drawn)


def cell_table(sweep: Sweep) -> TextTable:
    rows: list[tuple[str, ...]] = [
        (
            str(row["cell"]),
            settings_text(json.loads(row["settings"])),
            str(row["host"]),
            str(row["state"]) + (f": {row['error']}" if row["error"] else ""),
            str(row["repeat"]),
            str(row["attempt"]),
            f"{row['wall_s']:.1f}",
        )
        for row in sweep.cells.to_dict("records")
    ]
    return TextTable("Cells", ("cell", "settings", "host", "state", "repeat", "attempt", "took s"), rows, 4)


def measured_table(settings: Sequence[Mapping[str, Any]], runs: Split) -> TextTable | None:
    """Make a table of the numbers of latency and throughput cells; None if there are none."""
    rows: list[tuple[str, ...]] = []
    for setting, (run, cells) in zip(settings, runs, strict=True):
        for cell in cells:
            what, values = _quantity(cell, run)
            numbers = entries(values, MEAN_SD, "median", "p99")
            host = str(run.manifest.get("host", ""))
            rows.append((settings_text(setting), cell.name, what, host, str(cell.n), str(cell.errors), *numbers))
    if not rows:
        return None
    header = ("settings", "cell", "what", "host", "n", "errors", "mean ± sd", "median", "p99")
    return TextTable("Measured cells side by side", header, rows, 4, notes=tuple(stand_ins(runs)))


def settings_text(settings: Mapping[str, Any]) -> str:
    """Return settings as text: payload jpeg, size 640x480."""
    return ", ".join(f"{name} {value}" for name, value in settings.items()) or "defaults"


def pooled(sweep: Sweep, runs: Runs) -> tuple[list[StoredRun], Runs]:
    """Combine the computed timelines of equal configurations; return them, and the other runs."""
    groups: dict[str, list[list[StoredRun]]] = {}
    single = []
    for settings, run in runs:
        if run.manifest["command"] != "timeline" or set(run.table(TIMELINES)["mode"]) != {"virtual"}:
            single.append((settings, run))
            continue
        common = {name: value for name, value in run.manifest["configuration"].items() if name not in _AXES}
        pools = groups.setdefault(json.dumps(common, sort_keys=True), [])
        cells = set(run.table(TIMELINES)["cell"])
        for pool in pools:
            if all(cells.isdisjoint(other.table(TIMELINES)["cell"]) for other in pool):
                pool.append(run)
                break
        else:
            pools.append([run])
    return [_joined(sweep, pool) for pools in groups.values() for pool in pools], single


def _joined(sweep: Sweep, runs: Sequence[StoredRun]) -> StoredRun:
    """Combine runs into one: their rows in the order of the cells, shared tokens once."""
    import pandas as pd

    tables = {
        table.name: pd.concat([run.table(table) for run in runs], ignore_index=True)
        for table in (TIMELINES, SKILLS, TOKENS)
    }
    tables["tokens"] = tables["tokens"].drop_duplicates(["request_id", "index"], ignore_index=True)
    manifest = dict(runs[0].manifest)
    for name in ("boards", "warnings"):
        every = [each for run in runs for each in run.manifest.get(name, [])]
        manifest[name] = list({json.dumps(each, sort_keys=True): each for each in every}.values())
    manifest["calibrations"] = {
        name: found for run in runs for name, found in (run.manifest.get("calibrations") or {}).items()
    }
    cells = {name: origin for run in runs for name, origin in run.origins.cells.items()}
    manifest["provenance"] = Origins(runs[0].origins.run, cells).to_manifest()
    return StoredRun(sweep.path, manifest, tables)


def _quantity(cell: RequestCell, run: StoredRun) -> tuple[str, Floats]:
    """Return name and values of tokens/s of a throughput run, else of e2e without inference if it is known."""
    if run.manifest["command"] == "throughput":
        return "tokens/s", cell.values("tokens_per_s")
    metric = next((name for name in ("e2e_without_inference", "e2e") if cell.values_ms(name).size), "e2e")
    return f"{metric_phrase(metric)}, ms", cell.values_ms(metric)
