"""From folders to chapters: one for a run; an overview and the runs of the cells for a sweep.

Computed timelines of a sweep are combined into one run. Measured cells stay separate runs, since machines and moments
differ.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import StoreError, UsageError
from s2a_bench.experiments import Shown, Tables, experiment_of
from s2a_bench.experiments.latency.view import against_bytes
from s2a_bench.experiments.requests import RequestCell, RequestCells, cells_of, metric_phrase, stand_ins
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.report.compare.agreement import SETTING, Difference, differences, differing_names, is_other_machine
from s2a_bench.stats import Floats
from s2a_bench.store.manifest import NAME as MANIFEST
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import StoredRun, fits, read_run
from s2a_bench.store.sweep import Sweep, is_sweep, read_sweep
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import marked
from s2a_bench.writers.tables import MEAN_SD, TextTable, entries

MOST_CHAPTERS = 12
"""Runs of a sweep that have a chapter; the others are in the overview only."""
MOST_RUNS = 200
"""Runs of a folder that are shown."""
_AXES: Final = ("policies", "profiles", "rates", "tokens_per_skill", "n_skills", "t_nom_s")
"""Options that may differ between combined timelines; they are in the name of a timeline's cell."""
Runs = Sequence[tuple[dict[str, Any], StoredRun]]
"""Settings and run of each cell."""


@dataclass(frozen=True, slots=True)
class Chapter:
    """One run on the page, or several of a sweep; ``name`` is a folder, ``attached`` has texts by file name."""

    name: str
    title: str
    run: StoredRun
    content: Shown
    command: str
    caveats: Sequence[str] = ()
    attached: Mapping[str, str] = field(default_factory=dict)

    @property
    def every_caveat(self) -> list[str]:
        """Return the caveats, and what could not be built so far; figures are built last."""
        return [*self.caveats, *(f"Not shown: {failure}." for failure in self.content.failures)]


def run_folders(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Return the run folders that paths name or hold, those of one folder by their start, and what is left out.

    Raises UsageError if there is no run, StoreError for a path that does not exist.
    """
    folders: list[Path] = []
    lines: list[str] = []
    for path in paths:
        try:
            if (path / MANIFEST).exists() or not path.exists():
                folders.append(path)
                continue
            entries = sorted(path.iterdir()) if path.is_dir() else []
        except OSError as error:
            raise StoreError(f"cannot read {path}: {error.strerror}") from error
        held = []
        for entry in entries:
            try:
                held.append((str(read_run(entry).manifest.get("started")), entry))
            except StoreError as error:
                what, _, why = str(error).partition(": ")
                lines.append(f"skipped: {what}" + ("" if what.endswith("is not a run folder") else f": {why}"))
        if not held:
            lines.append(f"skipped: {path} is not a run folder, and holds none")
        if len(held) > MOST_RUNS:
            lines.append(f"{path} holds {len(held)} runs: the latest {MOST_RUNS} are used; name the folders of others")
        folders += [entry for _, entry in sorted(held)[-MOST_RUNS:]]
    if not folders:
        holder = next((f", as {each.parents[1]}" for path in paths for each in path.glob(f"*/*/{MANIFEST}")), "")
        named = ", ".join(map(str, paths))
        raise UsageError(f"no run folder: {named}; name run folders, or a folder that holds some{holder}")
    return folders, lines


def read_chapters(paths: Sequence[Path], *, against: str = "") -> list[Chapter]:
    """Read run folders and sweeps, each once, in order, beside a reference; raises StoreError for a damaged one."""
    chapters: list[Chapter] = []
    for path in dict.fromkeys(path.resolve() for path in paths):
        run = read_run(path)
        if is_sweep(run.manifest):
            chapters += _sweep(read_sweep(path), against)
        else:
            chapters.append(_chapter(run, title_of(run.manifest), against))
    names = [chapter.name for chapter in chapters]
    numbers = [names[:place].count(name) + 1 for place, name in enumerate(names)]
    return [
        replace(chapter, name=f"{chapter.name}-{number}") if number > 1 else chapter
        for chapter, number in zip(chapters, numbers, strict=True)
    ]


def title_of(manifest: Mapping[str, Any]) -> str:
    return f"{manifest.get('command', 'a run')} on {manifest.get('host', 'an unknown host')}, {when(manifest)}"


def when(manifest: Mapping[str, Any]) -> str:
    return str(manifest.get("started", "at an unknown time")).replace("T", " ").replace("+00:00", " UTC")


def repeat_command(manifest: Mapping[str, Any]) -> str:
    return shlex.join(["s2a-bench", *map(str, manifest.get("argv", [])[1:])])


def differences_of(chapters: Sequence[Chapter]) -> list[str]:
    """Return a line for each run of another machine than the first, and one line of all other differences."""
    unlike: dict[str, list[str]] = {}
    others: list[Difference] = []
    of_command: dict[str, StoredRun] = {}
    for chapter in chapters:
        same = of_command.setdefault(str(chapter.run.manifest["command"]), chapter.run)
        every = differences(chapters[0].run, chapter.run)
        others += [each for each in every if not each.what.startswith(SETTING)]
        others += [each for each in differences(same, chapter.run) if each.what.startswith(SETTING)]
        if what := "; ".join(str(each) for each in every if is_other_machine(each)):
            unlike.setdefault(what, []).append(chapter.title)
    lines = [
        f"{titles[0]}{f' and {len(titles) - 1} more' if len(titles) > 1 else ''} ran on another machine "
        f"than {chapters[0].title} ({what}): their numbers are side by side, and none combines both."
        for what, titles in unlike.items()
    ]
    names = differing_names(others)
    return [*lines, f"The runs differ in {names}."] if names else lines


def _chapter(run: StoredRun, title: str, against: str, command: str = "") -> Chapter:
    """Make the chapter of a run; an unfinished one may lack the rows of its tables."""
    with fits(run):
        content = content_of(run, against)
    caveats = list(_unfinished(run.manifest))
    return Chapter(_slug(run.path.name), title, run, content, command or repeat_command(run.manifest), caveats)


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name) or "run"


def _unfinished(manifest: Mapping[str, Any]) -> Iterator[str]:
    state = manifest.get("state")
    if state == "running":
        yield "This run has not finished: it is still running, or was killed. The following are its rows so far."
    elif state != "finished":
        why = f": {manifest['error']}" if manifest.get("error") else ""
        yield f"This run ended early ({state}{why}). The following are its rows until then."


def _sweep(sweep: Sweep, against: str) -> Iterator[Chapter]:
    manifest, runs = sweep.manifest, list(sweep.runs())
    head = StoredRun(sweep.path, {**manifest, "provenance": sweep.origins.to_manifest()})
    copy = sweep.path / "sweep.toml"
    attached = {copy.name: copy.read_text(encoding="utf-8")} if copy.is_file() else {}
    caveats = list(_unfinished(manifest))
    with fits(head):
        pools, single = pooled(sweep, runs)
        content = overview(sweep, runs)
    if len(single) > MOST_CHAPTERS:
        caveats.append(
            f"{len(single)} cells were run: the first {MOST_CHAPTERS} have a chapter each, all are in the overview; "
            "pass the folders of others to s2a-bench report to see them."
        )
    command = repeat_command(manifest)
    yield Chapter(_slug(sweep.path.name), title_of(manifest), head, content, command, caveats, attached)
    for place, run in enumerate(pools, 1):
        what = f"{run.manifest['command']}s of the sweep" + (f", part {place}" if len(pools) > 1 else "")
        yield _chapter(run, what, against, command=command)
    varied = {name for settings, _ in single for name in settings if settings[name] != single[0][0].get(name)}
    for settings, run in single[:MOST_CHAPTERS]:
        own = {name: value for name, value in settings.items() if name in varied or not varied}
        yield _chapter(run, f"{run.manifest['command']}: {settings_text(own)} ({run.path.name})", against)


def content_of(run: StoredRun, against: str) -> Shown:
    """Return the content of a run; for an unknown command it is the names of its tables."""
    if not run.row_counts():
        return Shown(("The run has no rows: it ended before anything was measured.",))
    if (experiment := experiment_of(str(run.manifest["command"]))) is not None:
        return experiment.show(run, against=against)
    rows = [f"{name} ({count} rows)" for name, count in run.row_counts().items()]
    return Shown((f"There is no view of {run.manifest['command']} runs; this one has {', '.join(rows)}.",))


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
    cells = [cells_of(run) for _, run in runs]
    findings, lines, figures = against_bytes.shown(cells)
    measured = partial(measured_table, [settings for settings, _ in runs], cells)
    builders: Tables = {**lines, "overview": measured, "cells": partial(cell_table, sweep)}
    shown = Shown.build(builders, [*lines, "overview"], csvs=lambda: {"cells.csv": CsvTable.of_frame(sweep.cells)})
    line = sweep.origins.line
    tables = {name: replace(table, provenance=line) for name, table in shown.tables.items()}
    drawn = {name: partial(marked, build, *(run for _, run in runs)) for name, build in figures.items()}
    return replace(shown, sentences=[*findings, *sentences], tables=tables, figures=drawn)


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


def measured_table(settings: Sequence[Mapping[str, Any]], runs: Sequence[RequestCells]) -> TextTable | None:
    """Make a table of the numbers of latency and throughput cells; None if there are none."""
    rows: list[tuple[str, ...]] = []
    for setting, cells in zip(settings, runs, strict=True):
        host = str(cells.run.manifest.get("host", ""))
        for cell in cells:
            what, values = _quantity(cell, str(cells.run.manifest["command"]))
            numbers = entries(values, MEAN_SD, "median", "p99")
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
    calibrations: dict[str, Any] = {}
    cells: dict[str, Provenance] = {}
    for run in runs:
        calibrations |= run.manifest.get("calibrations") or {}
        cells |= run.origins.cells
    manifest["calibrations"] = calibrations
    manifest["provenance"] = Origins(runs[0].origins.run, cells).to_manifest()
    return StoredRun(sweep.path, manifest, tables)


def _quantity(cell: RequestCell, command: str) -> tuple[str, Floats]:
    """Return name and values of tokens/s of a throughput run, else of e2e without inference if it is known."""
    if command == "throughput":
        return "tokens/s", cell.values("tokens_per_s")
    metric = next((name for name in ("e2e_without_inference", "e2e") if cell.values(name).size), "e2e")
    return f"{metric_phrase(metric)}, ms", cell.values(metric)
