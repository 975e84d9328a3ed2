"""Write a report: figures, the page, and tables for papers and programs, in a folder a run."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench import __version__
from s2a_bench.errors import StoreError
from s2a_bench.provenance import Origins, joined
from s2a_bench.report.page import GENERATOR, ReportConfig
from s2a_bench.report.page.chapters import Chapter, differences_of
from s2a_bench.report.verdicts import Verdicts, judge
from s2a_bench.store.manifest import utc_now
from s2a_bench.store.run import fits
from s2a_bench.text import visible
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import caption_of
from s2a_bench.writers.latex import document, escape, to_float
from s2a_bench.writers.style import PAGE_IN, WIDTH_IN, paper_column
from s2a_bench.writers.tables import Note, markdown_text, to_markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class DrawnFigure:
    """One figure as SVG for HTML, the first also of the width of a page, and as PDF if that is an output.

    ``title`` and ``notes`` are its caption; a ``wide`` one spans both columns of a paper.
    """

    svgs: Sequence[str]
    title: str
    notes: Sequence[str]
    wide: bool
    pdf: bytes | None


def draw(chapter: Chapter, *, page: bool = True, pdf: bool = False) -> dict[str, DrawnFigure]:
    """Build each figure, for a page as SVG without its line of provenance, the first in two widths."""
    import matplotlib as mpl

    drawn = {}
    for place, (name, build) in enumerate(chapter.content.figures.items()):
        svgs: list[str] = []
        with chapter.content.noted(f"figure {name}"):
            for width_in in (PAGE_IN, WIDTH_IN) if page and not place else (WIDTH_IN,):
                prefix = f"{re.sub(r'[^A-Za-z0-9]', '-', chapter.name)}-{place}-{len(svgs)}-"
                style: Any = {"svg.fonttype": "path", "svg.hashsalt": prefix}
                with paper_column(width_in), mpl.rc_context(style):
                    figure = build()
                    as_pdf = _saved(figure, "pdf", "CreationDate") if pdf and width_in == WIDTH_IN else None
                    if page:
                        figure.suptitle("").set_in_layout(False)
                        svg = _saved(figure, "svg", "Creator", "Date", "Format", "Type").decode()
                        svgs.append(inline(svg[svg.index("<svg") :], prefix))
            title, *notes = caption_of(figure)
            drawn[name] = DrawnFigure(svgs, title, notes, figure.get_figwidth() > WIDTH_IN, as_pdf)
    return drawn


def _saved(figure: Figure, suffix: str, *without: str) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format=suffix, metadata=dict.fromkeys(without))
    return out.getvalue()


def inline(svg: str, prefix: str) -> str:
    """Prepare an SVG for HTML: no namespaces, metadata and styles (they would apply to the page), unique ids.

    Paths keep two decimals.
    """
    svg = re.sub(r"<!--.*?-->\s*|<(metadata|style)\b.*?</\1>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r' d="[^"]*"', lambda path: re.sub(r"\s*\n|(?<=\.\d\d)\d+", "", path[0]), svg)
    svg = svg.replace("xlink:href=", "href=")
    return re.sub(r'(\bid="|href="#|url\(#)', lambda match: match[1] + prefix, svg)


_MARK = f"<!-- {GENERATOR} -->"
_LONG_ROWS = 30
"""A longer table needs more than one page."""
_OPEN_ROWS = 40
"""A longer table is folded."""


@dataclass(frozen=True, slots=True)
class Report:
    """A report: its chapters, the verdicts of their runs on a reference's claims, and the caveats."""

    chapters: Sequence[Chapter]
    judged: Verdicts | None
    caveats: Sequence[str]

    @property
    def origins(self) -> Origins:
        return joined(chapter.run.origins for chapter in self.chapters)


def make_report(chapters: Sequence[Chapter], *, against: str = "") -> Report:
    """Judge the claims of a reference, if one is named, and find the differences between the runs."""
    runs = [chapter.run for chapter in chapters]
    with fits(*runs):
        judged = judge(against, runs)
    return Report(chapters, judged, differences_of(chapters))


def write_report(report: Report, config: ReportConfig) -> list[Path]:
    """Write the outputs and return their files; raises StoreError."""
    drawn = {
        chapter.name: draw(chapter, page=config.page is not None, pdf=config.latex is not None)
        for chapter in report.chapters
        if config.page or config.latex
    }
    texts: dict[Path, str | bytes] = {}
    if config.page:
        with fits(*(chapter.run for chapter in report.chapters)):
            texts[config.page] = _page(report, drawn)
    if config.latex:
        texts |= {config.latex / name: text for name, text in _latex(report, drawn)}
    if config.csv:
        texts |= {config.csv / name: text for name, text in _csv(report)}
    if config.markdown:
        texts[config.markdown] = _markdown(report)
    for path, text in texts.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "backslashreplace"))
        except OSError as error:
            raise StoreError(f"cannot write {path}: {error.strerror}; name another place") from error
    return list(texts)


def _latex(report: Report, drawn: dict[str, dict[str, DrawnFigure]]) -> Iterator[tuple[str, str | bytes]]:
    sections = []
    if report.judged:
        table = report.judged.table(report.origins.line)
        yield "claims.tex", to_float(table, ("18mm", "34mm", "44mm", "20mm", "46mm", "78mm"), long=True)
        sections.append(r"\input{claims}")
    for chapter in report.chapters:
        lines = [f"\\section*{{{escape(chapter.title)}}}"]
        for name, table in chapter.content.tables.items():
            yield f"{chapter.name}/{name}.tex", to_float(table, long=len(table.rows) > _LONG_ROWS)
            lines.append(f"\\input{{{chapter.name}/{name}}}")
        for name, figure in drawn.get(chapter.name, {}).items():
            if figure.pdf:
                yield f"{chapter.name}/{name}.pdf", figure.pdf
                graphic = f"\\includegraphics{{{chapter.name}/{name}.pdf}}"
                caption = escape(" ".join((f"{figure.title}.", *figure.notes)))
                lines.append(f"\\begin{{figure}}[htbp]\\centering{graphic}\\caption{{{caption}}}\\end{{figure}}")
        sections.append("\n".join(lines))
    yield "report.tex", document("s2a-bench report", sections)


def _csv(report: Report) -> Iterator[tuple[str, str]]:
    if report.judged:
        rows = [(row[3], *row[:3], *row[4:]) for row in report.judged.table().rows]
        header = ("verdict", "where", "claim", "rule", "required", "evidence")
        yield "claims.csv", CsvTable.of(header, rows).text(report.origins)
    for chapter in report.chapters:
        for name, table in chapter.content.csvs.items():
            yield f"{chapter.name}/{name}", table.text(chapter.run.origins)


def _markdown(report: Report) -> str:
    blocks = [_MARK, *(f"> {markdown_text(caveat)}" for caveat in report.caveats)]
    if report.judged:
        blocks.append(f"## {report.judged.title}'s claims\n\n{report.judged.tally}.")
        blocks.append(to_markdown(report.judged.table(report.origins.line)))
    for chapter in report.chapters:
        blocks.append(f"## {markdown_text(chapter.title)}")
        blocks += [f"> {markdown_text(caveat)}" for caveat in chapter.every_caveat]
        blocks.append("\n".join(f"- {markdown_text(text)}" for text in chapter.content.sentences))
        blocks.append(f"```sh\n{visible(chapter.command)}\n```")
        blocks += [to_markdown(table) for table in chapter.content.tables.values()]
    return "\n\n".join(filter(None, blocks)) + "\n"


def _page(report: Report, drawn: dict[str, dict[str, DrawnFigure]]) -> str:
    """Return the page, one HTML file that fetches nothing; every text of a run is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    paths = {chapter.run.path for chapter in report.chapters}
    folders = [path for path in paths if paths.isdisjoint(path.parents)]  # a sweep's holds those of its runs
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
    world.tests["long"] = lambda text: len(text) > 80  # noqa: PLR2004 - two lines on a phone
    world.tests["longer"] = lambda rows: len(rows) > _OPEN_ROWS
    world.filters["short"] = lambda value: f"{value:.6g}"
    return world.get_template("page.html").render(
        generator=GENERATOR,
        version=__version__,
        made=utc_now().replace("T", " ").replace("+00:00", " UTC"),
        style=loader.get_source(world, "page.css")[0],
        script=loader.get_source(world, "page.js")[0],
        title=report.chapters[0].title if len(folders) == 1 else f"{len(folders)} runs, side by side",
        chapters=[(chapter, _view(chapter, [*drawn.get(chapter.name, {}).values()])) for chapter in report.chapters],
        judged=report.judged,
        caveats=report.caveats,
    )


def _view(chapter: Chapter, figures: Sequence[DrawnFigure]) -> dict[str, Any]:
    """Return what the page shows of a chapter besides its fields; ``about`` are the notes that open items share."""
    tables = chapter.content.tables
    notes = [note for table in tables.values() for note in table.notes if isinstance(note, Note)]
    labels = [label for note in notes for label in note.labels]
    opened = [table for name, table in tables.items() if name in chapter.content.main]
    noted = [*(table.notes for table in opened), *(figure.notes for figure in figures[:1])]
    return {
        "id": "run-" + re.sub(r"[^A-Za-z0-9_-]", "-", chapter.name),
        "labels": [*dict.fromkeys((*chapter.run.origins.labels, *labels))],
        "about": [note for note in dict.fromkeys(chain(*noted)) if sum(note in notes for notes in noted) > 1],
        "figures": figures,
        "opened": opened,
        "facts": {name: fact["about"] for name, fact in chapter.run.facts.items()},
    }
