"""`compare`: changes between runs, and gates; `report`: a page or files of runs."""

from __future__ import annotations

from pathlib import Path

import typer

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_error, print_failures, print_json, print_line, print_table
from s2a_bench.errors import TRIPPED, UNDECIDED, UsageError
from s2a_bench.options import Options, listed, option
from s2a_bench.report.page import ReportConfig


class CompareConfig(Options):
    """Two sides, each a run folder or repeated launches with commas between them."""

    baseline: str = option(..., "run folder; repeated launches with commas", flag="a", argument=True)
    other: str = option(..., "compared with A: one folder, or several as above", flag="b", argument=True)
    metric: list[str] = option(
        [], "METRIC or METRIC.STATISTIC (median, mean, p90, p99), with commas; or all [default: a few]"
    )
    fail_if: list[str] = option(
        [], "gate, e.g. e2e.median>5%, tokens_per_s<-5%, ros/topic:e2e.p99>10%; may be repeated"
    )
    strict: bool = option(False, "gates trip on any change beyond the limit, significant or not")
    one_launch: bool = option(
        False, "gates also judge fewer than 3 launches a side: they trip on differences between launches"
    )
    min_effect: float = option(5.0, "the smallest relevant change, in per cent", ge=0)
    unlike: bool = option(False, "also compare runs of different machines, models or settings")
    output: Path | None = option(None, "folder for table, figure and JSON")

    def check(self) -> None:
        for name in ("strict", "one_launch"):
            if getattr(self, name) and not self.fail_if:
                raise UsageError(f"`{name}`: no gate; add `fail_if`")


def _compare(config: CompareConfig, *, json_: Json = False) -> None:
    from s2a_bench.report.compare import comparison, gates, shown

    conditions = [gates.read_gate(text) for text in config.fail_if]
    baseline, other = comparison.read_side(config.baseline, "A"), comparison.read_side(config.other, "B")
    compared = comparison.open_comparison(baseline, other, unlike=config.unlike, least=config.min_effect / 100)
    wanted = comparison.metrics_of(compared, [name for text in config.metric for name in listed(text)])
    compared = comparison.compare(compared, [*wanted, *gates.concerned(compared, conditions)])
    gated = gates.judge(compared, conditions, strict=config.strict, one_launch=config.one_launch)
    warnings = comparison.warnings_of(compared)
    whole = shown.compare_json(compared, gated, warnings)
    for warning in warnings:
        print_error(f"note [{warning.code}]: {warning.message}; {warning.advice}")
    written = shown.write_comparison(config.output, compared, whole) if config.output else []
    if json_:
        print_json(whole)
    else:
        table = shown.compare_table(compared)
        print_table(table)
        for line in (*table.notes, *(f"written: {path}" for path in written)):
            print_line(line)
    for one in gated:
        line = f"gate {one.gate} {one.outcome} in {one.cell}: {shown.change_text(one.change, one.ci95)}"
        line += "" if one.p_holm is None else f", p = {one.p_holm:.2g}"
        line += "" if one.detectable is None else f", sees {shown.detectable_text(one.detectable)}"
        print_error(f"{line}; {one.reason}" if one.reason else line)
    outcomes = {one.outcome for one in gated}
    if "tripped" in outcomes:  # comes before an undecided one
        raise typer.Exit(TRIPPED)
    raise typer.Exit(UNDECIDED if "undecided" in outcomes else 0)


compare = command(_compare, CompareConfig)


def _report(config: ReportConfig) -> None:
    from s2a_bench.report.export import write_exports
    from s2a_bench.report.page.chapters import read_chapters, run_folders
    from s2a_bench.report.page.files import make_report, write_report

    folders, left_out = run_folders(config.runs)
    for line in left_out:
        print_error(line)
    page = make_report(read_chapters(folders, against=config.against), against=config.against)
    written = write_report(page, config)
    shared = write_exports(folders, config.export) if config.export else []
    of_chapters = (f"{chapter.title}: {caveat}" for chapter in page.chapters for caveat in chapter.every_caveat)
    for caveat in (*page.caveats, *of_chapters):
        print_error(f"warning: {caveat}")
    if page.judged:
        print_line(f"{page.judged.of.title}'s claims: {page.judged.tally}")
    outputs = {"page": config.page, "Markdown": config.markdown, "LaTeX": config.latex, "CSV": config.csv}
    for what, path in outputs.items():
        if path is not None:
            inside = sum(path in (each, *each.parents) for each in written)
            count = f", {inside} files" if inside > 1 else ""
            print_line(f"{what}: {path}{count}")
    for folder in shared:
        print_line(f"run to share: {folder}")
    whole = [chapter for chapter in page.chapters if chapter.run.manifest.get("state") == "finished"]
    print_failures(*((chapter.run.path, chapter.content.failures) for chapter in whole))


report = command(_report, ReportConfig)
