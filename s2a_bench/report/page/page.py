"""The page: one HTML file that includes its styles, its script and its figures, and fetches nothing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from s2a_bench import __version__
from s2a_bench.report.page import GENERATOR
from s2a_bench.report.page.chapters import when
from s2a_bench.store.manifest import utc_now
from s2a_bench.store.sweep import is_sweep
from s2a_bench.text import visible
from s2a_bench.writers.tables import Note

if TYPE_CHECKING:
    from s2a_bench.report.page.chapters import Chapter
    from s2a_bench.report.page.files import DrawnFigure
    from s2a_bench.report.verdicts import Verdicts


def render(
    chapters: Sequence[Chapter],
    figures: dict[str, dict[str, DrawnFigure]],
    judged: Verdicts | None,
    caveats: Sequence[str],
) -> str:
    """Return the page; ``figures`` are by the name of the chapter. Every text of a run is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("s2a_bench.report.page", "templates")
    world = Environment(
        loader=loader,
        autoescape=True,
        finalize=lambda value: visible(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    world.filters["parts"] = re.compile(r" (?=[(\[])").split  # a number, and its spread or interval
    world.filters["short"] = lambda value: f"{value:.6g}"
    shown = [_view(chapter, figures.get(chapter.name, {})) for chapter in chapters]
    return world.get_template("page.html").render(
        generator=GENERATOR,
        version=__version__,
        made=utc_now().replace("T", " ").replace("+00:00", " UTC"),
        style=loader.get_source(world, "page.css")[0],
        script=loader.get_source(world, "page.js")[0],
        title=title_of_page(chapters),
        chapters=shown,
        judged=judged,
        caveats=caveats,
    )


def title_of_page(chapters: Sequence[Chapter]) -> str:
    """Return the title of the only folder, or the number of folders; a sweep's chapters count as one."""
    sweeps = {chapter.run.path for chapter in chapters if is_sweep(chapter.manifest)}
    folders = [chapter for chapter in chapters if sweeps.isdisjoint(chapter.run.path.parents)]
    names = {chapter.run.path: chapter.title for chapter in reversed(folders)}
    return next(iter(names.values())) if len(names) == 1 else f"{len(names)} runs, side by side"


def _view(chapter: Chapter, figures: dict[str, DrawnFigure]) -> dict[str, Any]:
    content, manifest = chapter.content, chapter.manifest
    main = [content.tables[name] for name in content.main]
    notes = [note for table in content.tables.values() for note in table.notes if isinstance(note, Note)]
    labels = [label for note in notes for label in note.labels]
    return {
        "id": "run-" + re.sub(r"[^A-Za-z0-9_-]", "-", chapter.name),
        "title": chapter.title,
        "folder": str(chapter.run.path),
        "state": manifest.get("state", "unknown"),
        "started": when(manifest),
        "labels": list(dict.fromkeys((*chapter.run.origins.labels, *labels))),
        "summary": content.sentences,
        "caveats": chapter.every_caveat,
        "warnings": manifest.get("warnings", []),
        "tables": main,
        "more": [table for name, table in content.tables.items() if name not in content.main],
        "lanes": content.lanes,
        "figures": figures,
        "command": chapter.command,
        "attached": chapter.attached,
        "environment": list(_facts(manifest.get("environment", {}))),
        "model": list(_facts(manifest.get("model") or {})),
        "configuration": list(_facts(manifest.get("configuration", {}))),
        "facts": [(name, fact["about"]) for name, fact in chapter.run.facts.items()],
        "seeds": list(_facts(manifest.get("seeds", {}))),
    }


def _facts(facts: Any, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(facts, dict):
        return [
            line for name, value in facts.items() for line in _facts(value, f"{prefix}.{name}" if prefix else str(name))
        ]
    if isinstance(facts, list) and any(isinstance(each, dict) for each in facts):
        return [line for place, value in enumerate(facts) for line in _facts(value, f"{prefix}.{place}")]
    if facts is None or facts in ("", []):
        return []
    text = ", ".join(map(str, facts)) if isinstance(facts, list) else str(facts)
    return [(prefix, text)]
