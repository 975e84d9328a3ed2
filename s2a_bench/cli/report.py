"""`s2a-bench report`: runs as one page to look at, and as tables and figures to publish."""

from __future__ import annotations

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import shown
from s2a_bench.report.page.config import ReportConfig


def _report(config: ReportConfig) -> None:
    from rich.console import Console

    from s2a_bench.report.page.chapters import read_chapters
    from s2a_bench.report.page.files import make_report, write_report
    from s2a_bench.report.page.page import tally

    against_paper = bool(config.against)
    found = make_report(read_chapters(config.runs, against_paper=against_paper), against_paper=against_paper)
    errors = Console(stderr=True)
    unfinished = [f"{chapter.title}: {caveat}" for chapter in found.chapters for caveat in chapter.caveats]
    for caveat in (*found.caveats, *unfinished):
        errors.print(shown(f"warning: {caveat}"), markup=False, highlight=False, soft_wrap=True)
    written = write_report(found, config)
    console = Console()
    if found.judged:
        console.print(f"the paper's claims: {tally(found.judged)}", markup=False, highlight=False, soft_wrap=True)
    outputs = (config.page, "page"), (config.markdown, "Markdown"), (config.latex, "LaTeX"), (config.csv, "CSV")
    for path, what in outputs:
        if path is not None:
            inside = sum(path in (each, *each.parents) for each in written)
            count = f", {inside} files" if inside > 1 else ""
            console.print(f"{what}: {path}{count}", markup=False, highlight=False, soft_wrap=True)


report = command(_report, ReportConfig)
