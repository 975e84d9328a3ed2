"""What a sweep shows: its cells at a glance, and timelines that were computed cell by cell put together again.

Only what is computed is put together: measured cells stay runs of their own, since machines and moments differ.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments import Shown
from s2a_bench.experiments.latency.view import against_bytes
from s2a_bench.experiments.requests import RequestCell, metric_phrase, split, stand_ins
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.policy import Floats
from s2a_bench.provenance import Origins
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import StoredRun
from s2a_bench.store.sweep import Sweep
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import marked
from s2a_bench.writers.tables import MEAN_SD, TextTable, entries

if TYPE_CHECKING:
    from s2a_bench.experiments.requests import Split


Runs = Sequence[tuple[dict[str, Any], StoredRun]]

_AXES: Final = ("policies", "profiles", "rates", "tokens_per_skill", "n_skills", "t_nom_s")
"""What may differ between timelines that belong together: the name of a timeline's cell tells these apart."""


def overview(sweep: Sweep, runs: Runs) -> Shown:
    """Return the cells of a sweep with what became of them, and the numbers of measured ones side by side."""
    states = sweep.cells["state"].value_counts().to_dict()
    asked = int(sweep.manifest["configuration"].get("cells", len(sweep.cells)))
    done = int(states.get("finished", 0))
    said = [f"{done} of {asked} cells of s2a-bench {sweep.manifest['configuration']['command']} are finished."]
    if failed := int(states.get("failed", 0)):
        said.append(f"{failed} failed; the table of cells says why, and --resume --retry-failed runs them again.")
    tables = {"cells": cell_table(sweep)}
    cells = split(run for _, run in runs)
    if measured := measured_table([settings for settings, _ in runs], cells):
        tables = {"overview": measured, **tables}
    lines, figures = against_bytes.shown(cells)
    line = sweep.origins.line
    tables = {name: replace(table, provenance=line) for name, table in (lines | tables).items()}
    csvs = {"cells.csv": CsvTable.of_frame(sweep.cells)}
    drawn = {name: partial(marked, build, *(run for _, run in runs)) for name, build in figures.items()}
    main = [*lines, *(["overview"] if measured else [])]
    return Shown(said, tables, main, csvs=csvs, figures=drawn)


def cell_table(sweep: Sweep) -> TextTable:
    """Lay out every cell: what was set, where it ran, how it ended, how long it took."""
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
    """Lay out the numbers of latency and throughput cells side by side; None where there are none."""
    pairs = zip(settings, runs, strict=True)
    rows = [row for each, (run, cells) in pairs for row in _measured(settings_text(each), run, cells)]
    if not rows:
        return None
    header = ("settings", "cell", "what", "host", "n", "errors", "mean ± sd", "median", "p99")
    return TextTable("Measured cells side by side", header, rows, 4, notes=tuple(stand_ins(runs)))


def settings_text(settings: Mapping[str, Any]) -> str:
    """Write settings as a person would: payload jpeg, size 640x480."""
    return ", ".join(f"{name} {value}" for name, value in settings.items()) or "as the command has it"


def pooled(sweep: Sweep, runs: Runs) -> tuple[list[StoredRun], Runs]:
    """Put computed timelines of like configuration together; return them and the runs that stay alone."""
    groups: dict[str, list[list[StoredRun]]] = {}
    single = []
    for settings, run in runs:
        if not _is_virtual(run):
            single.append((settings, run))
            continue
        asked = {name: value for name, value in run.manifest["configuration"].items() if name not in _AXES}
        parts = groups.setdefault(json.dumps(asked, sort_keys=True), [])
        free = next((part for part in parts if not any(_overlap(run, other) for other in part)), None)
        if free is None:
            parts.append([run])
        else:
            free.append(run)
    return [_joined(sweep, part) for parts in groups.values() for part in parts], single


def _is_virtual(run: StoredRun) -> bool:
    return run.manifest["command"] == "timeline" and set(run.table(TIMELINES)["mode"]) == {"virtual"}


def _overlap(one: StoredRun, other: StoredRun) -> bool:
    return not set(one.table(TIMELINES)["cell"]).isdisjoint(other.table(TIMELINES)["cell"])


def _joined(sweep: Sweep, runs: Sequence[StoredRun]) -> StoredRun:
    """Make one run of several: rows one below the other in the order of board, L, N, T; shared tokens once."""
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


def _measured(words: str, run: StoredRun, cells: Sequence[RequestCell]) -> Iterator[tuple[str, ...]]:
    if run.samples.empty:
        return
    for cell in cells:
        what, values = _quantity(cell, run)
        numbers = entries(values, MEAN_SD, "median", "p99")
        host = str(run.manifest.get("host", ""))
        yield words, cell.name, what, host, str(cell.n), str(cell.errors), *numbers


def _quantity(cell: RequestCell, run: StoredRun) -> tuple[str, Floats]:
    """Return what a cell is judged by: tokens/s of a throughput run, else e2e without inference where it is known."""
    if run.manifest["command"] == "throughput":
        return "tokens/s", cell.values("tokens_per_s")
    metric = next((name for name in ("e2e_without_inference", "e2e") if cell.values_ms(name).size), "e2e")
    return f"{metric_phrase(metric)}, ms", cell.values_ms(metric)
