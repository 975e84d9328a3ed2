"""`compare`: changes between runs, and gates; `report`: a page or files of runs."""

from __future__ import annotations

import typer

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_error, print_failures, print_json, print_line, print_table
from s2a_bench.errors import TRIPPED, UNDECIDED
from s2a_bench.report.compare import CompareConfig
from s2a_bench.report.page import ReportConfig


def _compare(config: CompareConfig, *, json_: Json = False) -> None:
    from s2a_bench.report.compare import comparison, gates, shown

    conditions = [gates.read_gate(text) for text in config.fail_if]
    sides = comparison.read_side(config.baseline, "A"), comparison.read_side(config.other, "B")
    compared = comparison.open_comparison(*sides, unlike=config.unlike, least=config.min_effect / 100)
    wanted = comparison.metrics_of(compared, config.metrics)
    compared = comparison.compare(compared, [*wanted, *gates.concerned(compared, conditions)])
    judgements = gates.judge(compared, conditions, strict=config.strict, one_launch=config.one_launch)
    found = comparison.warnings_of(compared)
    whole = shown.compare_json(compared, judgements, found)
    for warning in found:
        print_error(f"note [{warning.code}]: {warning.message}; {warning.advice}")
    written = shown.write_comparison(config.output, compared, whole) if config.output else []
    if json_:
        print_json(whole)
    else:
        table = shown.compare_table(compared)
        print_table(table)
        for line in (*table.notes, *(f"written: {path}" for path in written)):
            print_line(line)
    for one in judgements:
        line = f"gate {one.gate.text} {one.outcome} in {one.comparison.pair.name}: {shown.change_text(one.comparison)}"
        line += "" if one.comparison.p_holm is None else f", p = {one.comparison.p_holm:.2g}"
        line += "" if one.detectable is None else f", sees {shown.detectable_text(one.detectable)}"
        print_error(f"{line}; {one.reason}" if one.reason else line)
    outcomes = {one.outcome for one in judgements}  # a tripped gate comes before an undecided one
    raise typer.Exit(TRIPPED if gates.TRIPPED in outcomes else UNDECIDED if gates.UNDECIDED in outcomes else 0)


compare = command(_compare, CompareConfig)


def _report(config: ReportConfig) -> None:
    from s2a_bench.report.page.chapters import read_chapters
    from s2a_bench.report.page.files import make_report, write_report

    found = make_report(read_chapters(config.runs, against=config.against), against=config.against)
    written = write_report(found, config)
    of_chapters = (f"{chapter.title}: {caveat}" for chapter in found.chapters for caveat in chapter.every_caveat)
    for caveat in (*found.caveats, *of_chapters):
        print_error(f"warning: {caveat}")
    if found.judged:
        print_line(f"{found.judged.of.title}'s claims: {found.judged.tally}")
    outputs = {"page": config.page, "Markdown": config.markdown, "LaTeX": config.latex, "CSV": config.csv}
    for what, path in outputs.items():
        if path is not None:
            inside = sum(path in (each, *each.parents) for each in written)
            count = f", {inside} files" if inside > 1 else ""
            print_line(f"{what}: {path}{count}")
    whole = [chapter for chapter in found.chapters if chapter.manifest.get("state") == "finished"]
    print_failures(*((chapter.run.path, chapter.content.failures) for chapter in whole))


report = command(_report, ReportConfig)
