"""From run folders to chapters: one for a run; an overview and the runs of the cells for a sweep."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from s2a_bench.experiments import Shown, experiment_of
from s2a_bench.report.compare.agreement import SETTING, Difference, differences, differing_names, is_other_machine
from s2a_bench.report.page.sweeps import overview, pooled, settings_text
from s2a_bench.store.run import StoredRun, fits, read_run
from s2a_bench.store.sweep import Sweep, is_sweep, read_sweep

MOST_CHAPTERS = 12
"""Runs of a sweep that have a chapter; the others are in the overview only."""


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

    @property
    def manifest(self) -> dict[str, Any]:
        return self.run.manifest


def read_chapters(paths: Sequence[Path], *, against: str = "") -> list[Chapter]:
    """Read run folders and sweeps, each once, in order, beside a reference; raises StoreError for a damaged one."""
    found: list[Chapter] = []
    for path in dict.fromkeys(path.resolve() for path in paths):
        run = read_run(path)
        if is_sweep(run.manifest):
            found += _sweep(read_sweep(path), against)
        else:
            found.append(_chapter(run, title_of(run.manifest), against))
    return [_named(chapter, place, found) for place, chapter in enumerate(found)]


def title_of(manifest: Mapping[str, Any]) -> str:
    return f"{manifest.get('command', 'a run')} on {manifest.get('host', 'an unknown host')}, {when(manifest)}"


def when(manifest: Mapping[str, Any]) -> str:
    return str(manifest.get("started", "at an unknown time")).replace("T", " ").replace("+00:00", " UTC")


def repeat_command(manifest: Mapping[str, Any]) -> str:
    """Return the command line of a run, quoted for a shell."""
    return shlex.join(["s2a-bench", *map(str, manifest.get("argv", [])[1:])])


def differences_of(chapters: Sequence[Chapter]) -> list[str]:
    """Return a line for each run of another machine than the first, and one line of all other differences."""
    lines: list[str] = []
    others: list[Difference] = []
    of_command: dict[str, StoredRun] = {}
    for chapter in chapters:
        same = of_command.setdefault(str(chapter.manifest["command"]), chapter.run)
        found = differences(chapters[0].run, chapter.run)
        others += [each for each in found if not each.what.startswith(SETTING)]
        others += [each for each in differences(same, chapter.run) if each.what.startswith(SETTING)]
        if what := "; ".join(str(each) for each in found if is_other_machine(each)):
            lines.append(
                f"{chapter.title} ran on another machine than {chapters[0].title} ({what}): "
                "their numbers are side by side, and none combines both."
            )
    names = differing_names(others)
    return [*lines, f"The runs differ in {names}."] if names else lines


def _chapter(run: StoredRun, title: str, against: str, command: str = "") -> Chapter:
    """Make the chapter of a run; an unfinished one may lack the rows of its tables."""
    manifest = run.manifest
    caveats = list(_unfinished(manifest))
    with fits(run):
        content = content_of(run, against)
    return Chapter(_slug(run.path.name), title, run, content, command or repeat_command(manifest), caveats)


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
    for settings, run in single[:MOST_CHAPTERS]:
        yield _chapter(run, f"{run.manifest['command']}: {settings_text(settings)}", against)


def _named(chapter: Chapter, place: int, chapters: Sequence[Chapter]) -> Chapter:
    """Append a number to the second and later of equal names."""
    number = sum(other.name == chapter.name for other in chapters[: place + 1])
    return chapter if number == 1 else replace(chapter, name=f"{chapter.name}-{number}")


def content_of(run: StoredRun, against: str) -> Shown:
    """Return the content of a run; for an unknown command it is the names of its tables."""
    if not run.row_counts():
        return Shown(("The run has no rows: it ended before anything was measured.",))
    if (experiment := experiment_of(str(run.manifest["command"]))) is not None:
        return experiment.show(run, against=against)
    rows = [f"{name} ({count} rows)" for name, count in run.row_counts().items()]
    return Shown((f"There is no view of {run.manifest['command']} runs; this one has {', '.join(rows)}.",))
