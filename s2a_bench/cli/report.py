"""`compare`: changes between runs, and gates; `report`: a page or files of runs; `advise`: a transport for a link."""

from __future__ import annotations

import statistics
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated

import typer

from s2a_bench.cli.adapter import command
from s2a_bench.cli.output import Json, print_error, print_failures, print_json, print_line, print_table
from s2a_bench.errors import TRIPPED, UNDECIDED
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.requests import cells_of
from s2a_bench.inference import STAND_IN
from s2a_bench.report.advise import CHECKED, LONGEST_PAUSE_S, AdviseConfig
from s2a_bench.report.compare import CompareConfig
from s2a_bench.report.page import ReportConfig
from s2a_bench.store.run import read_run
from s2a_bench.transport import ACTIONS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2a_bench.progress import Progress
    from s2a_bench.report.advise.prediction import Advice


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


def _advise(
    config: AdviseConfig,
    *,
    output: Annotated[Path, typer.Option(help="folder for the runs of --check")] = Path("results"),
    json_: Json = False,
) -> None:
    from s2a_bench.cli.progress import RunProgress
    from s2a_bench.report.advise.prediction import advice_json, advice_table, advise, sentence

    found, profile, origin = advise(config)
    if config.measure:
        with RunProgress("samples") as progress:
            times_ms = _measured_ms(config, found[:CHECKED], output, progress)
        found[:CHECKED] = [replace(each, measured_ms=ms) for each, ms in zip(found, times_ms, strict=False)]
    if json_:
        print_json(advice_json(found, config, profile, origin))
        return
    print_table(table := advice_table(found, config, profile, origin))
    for line in (*table.notes, sentence(found, config, profile)):
        print_line(line)


def _measured_ms(config: AdviseConfig, found: Sequence[Advice], output: Path, progress: Progress) -> list[float]:
    """Return the medians of pipelines' e2e without inference on the emulated link, in ms, of one run at the rate."""
    from s2a_bench.experiments.latency.view.against_bytes import METRIC

    latency = EXPERIMENTS["latency"]
    requests = resolve_name(latency.config)(
        transports=tuple(each.name for each in found),
        link=config.link,
        engine={"name": STAND_IN, "answer": ACTIONS},
        size=config.size,
        cameras=config.cameras,
        state=14,
        requests=30,
        think_s=min(LONGEST_PAUSE_S, max(0.0, config.period_ms - max(each.e2e_ms for each in found)) / 1e3),
    )
    cells = {cell.name: cell for cell in cells_of(read_run(latency.run_with(requests, output, progress)))}
    return [float(statistics.median(cells[each.name].values_ms(METRIC))) for each in requests.pipelines]


advise = command(_advise, AdviseConfig)
