"""`s2a-bench report`: runs as one page to look at, and as tables and figures to publish."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from s2a_bench.errors import UsageError


def report(
    runs: Annotated[list[Path], typer.Argument(help="run folders, or the folder of a sweep; several side by side")],
    output: Annotated[
        Path | None, typer.Option(help="the page, one HTML file [default: report.html, if nothing else is asked for]")
    ] = None,
    latex: Annotated[
        Path | None, typer.Option(help="folder for LaTeX tables (booktabs, siunitx) and figures as PDF")
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="folder for CSV tables with every digit")] = None,
    markdown: Annotated[Path | None, typer.Option(help="all tables as one Markdown file")] = None,
    against: Annotated[
        str, typer.Option(help="paper: put the paper's claims beside ours, each with a verdict and its evidence")
    ] = "",
) -> None:
    """Make one self-contained page of runs, and their tables and figures for a paper. Measures nothing."""
    from rich.console import Console

    from s2a_bench.report.page.chapters import read_chapters
    from s2a_bench.report.page.files import Outputs, make_report, write_report
    from s2a_bench.report.page.page import tally

    if against not in {"", "paper"}:
        raise UsageError(f"--against: '{against}' should be paper; two runs are compared with s2a-bench compare")
    page = output if output or latex or csv or markdown else Path("report.html")
    outputs = Outputs(page, latex, csv, markdown)
    outputs.check()
    found = make_report(read_chapters(runs, against_paper=bool(against)), against_paper=bool(against))
    errors = Console(stderr=True)
    unfinished = [f"{chapter.title}: {caveat}" for chapter in found.chapters for caveat in chapter.caveats]
    for caveat in (*found.caveats, *unfinished):
        errors.print(f"warning: {caveat}", markup=False, highlight=False, soft_wrap=True)
    written = write_report(found, outputs)
    console = Console()
    if found.judged:
        console.print(f"the paper's claims: {tally(found.judged)}", markup=False, highlight=False, soft_wrap=True)
    for path, what in ((page, "page"), (markdown, "Markdown"), (latex, "LaTeX"), (csv, "CSV")):
        if path is not None:
            inside = sum(path in (each, *each.parents) for each in written)
            count = f", {inside} files" if inside > 1 else ""
            console.print(f"{what}: {path}{count}", markup=False, highlight=False, soft_wrap=True)
