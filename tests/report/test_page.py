"""The page: nothing fetched, nothing unescaped, and the numbers of the tables."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.experiments.timeline.view.cells import timelines_of
from s2a_bench.experiments.timeline.view.figures import page_lanes
from s2a_bench.experiments.timeline.view.tables import execution_table, timeline_csv
from s2a_bench.report.page import ReportConfig
from s2a_bench.report.page.chapters import MOST_CHAPTERS, read_chapters
from s2a_bench.report.page.files import inline, make_report, write_report
from s2a_bench.store.requests import SampleRow
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.store.sweep import CELLS, CellRow
from s2a_bench.testing import NullProgress
from s2a_bench.writers.figures import caption_of
from s2a_bench.writers.latex import escape, to_float
from s2a_bench.writers.style import paper_column
from s2a_bench.writers.tables import ABSENT, TextTable
from tests.made_runs import MakeRun
from tests.report.conftest import REAL

MakeRow = Callable[..., SampleRow]
HOSTILE = "<script>alert('x')</script>&\"%_$#{}\\"
VOID = {"meta", "br", "hr", "img", "input", "link"}
POLICIES = ("naive", "wait-then-act", "stream-to-act")


class Page(HTMLParser):
    """What a page is made of; checks while reading that every element is closed where it should be."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: Counter[str] = Counter()
        self.attributes: list[tuple[str, str, str]] = []
        self.cells: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "td":
            self.cells.append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "td" in self.open:
            self.cells[-1] += data
        if not {"script", "style"} & set(self.open):
            self.text += data

    def values(self, name: str) -> list[str]:
        return [value for _, found, value in self.attributes if found == name]


def timeline(folder: Path, **settings: Any) -> Path:
    return run_timeline(TimelineComputed(**settings), folder, NullProgress())


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return timeline(tmp_path_factory.mktemp("timeline"), profiles=("jetson-agx-orin",), tokens_per_skill=(6, 4))


def page_of(*paths: Path, against: str = "") -> str:
    output = paths[0].parent / "page.html"
    report = make_report(read_chapters(paths, against=against), against=against)
    assert write_report(report, ReportConfig(runs=paths, output=output)) == [output]
    return output.read_text()


@pytest.fixture(scope="module")
def shown(computed: Path) -> str:
    """The page of computed timelines."""
    return page_of(computed)


def sweep_of(folder: Path, runs: list[tuple[dict[str, Any], Path]], *, cells: int | None = None) -> Path:
    """Make a sweep's folder of run folders, which move there; a Path that is not there is a cell that failed."""
    facts = {"configuration": {"command": "timeline", "cells": cells or len(runs)}, "environment": {"cpu": "A"}}
    with RunWriter.create(folder, "sweep", facts, (CELLS,)) as writer:
        (writer.path / "sweep.toml").write_text('command = "timeline" # as it was\n')
        for number, (settings, path) in enumerate(runs, 1):
            kept = writer.path / "cells" / f"{number:04d}-r1"
            kept.parent.mkdir(exist_ok=True)
            ended = path.exists()
            if ended:
                path.rename(kept)
            row = CellRow(
                cell=f"{number:04d}",
                repeat=1,
                attempt=1,
                state="finished" if ended else "failed",
                error="" if ended else "no room",
                virtual=True,
                board="",
                host="vm",
                settings=settings,
                argv=["timeline"],
                config_hash="0",
                folder=f"cells/{kept.name}" if ended else "",
                started="2026-01-01T00:00:00+00:00",
                wall_s=0.5,
            )
            writer.append(CELLS, [row])
    return writer.path


def test_the_page_has_the_numbers_of_the_tables(computed: Path, shown: str) -> None:
    page = Page(shown)
    run = read_run(computed)
    table = execution_table(timelines_of(run), run.manifest)
    rows = [text for row in table.rows for text in row]
    start = page.cells.index(rows[0])
    assert page.cells[start : start + len(rows)] == rows
    assert all(note in " ".join(page.text.split()) for note in table.notes)
    assert "naive stalls in 1 of 2 settings, most on Jetson AGX Orin with L = 6: 1.75 s a plan" in page.text
    labels = [label.replace("&#39;", "'") for label in re.findall(r'class="label">([^<]*)', shown)]
    assert [*dict.fromkeys(labels)] == ["emulated", "paper's claim", "assumption"]
    captions = re.findall(r"<(?:caption|figcaption)>.*?</(?:caption|figcaption)>", shown, re.DOTALL)
    assert len(captions) == 4 + 2 + 1  # tables, timelines, a figure
    assert all(caption.count('class="label"') == 3 for caption in captions)
    assert shown.count(unescape(run.origins.line)) == 1  # once, below the heading


def test_a_latency_run_says_n_and_interval(make_run: MakeRun) -> None:
    page = Page(page_of(make_run(manifest={"warnings": [{"code": "load", "message": "busy", "advice": "wait"}]}).path))
    text = " ".join(page.text.split())
    assert "n = 50 samples a cell, warm-ups left out. 640x480; payload: raw; request mode." in text
    assert re.search(r"http/as-deployed takes [\d.]+ \[95 %: [\d.]+, [\d.]+\] times as long as ros/topic \(raw\)", text)
    assert "Warning [load]: busy; wait" in text
    assert "echo engine" in text
    assert page.tags["svg"] == 4  # the first figure in two widths
    order = [
        text.index(part)
        for part in ("Stages, medians", "http/as-deployed takes", "ratio to ros/topic", "decode return")
    ]
    assert order == sorted(order)


def test_hostile_names_are_text_and_nothing_else(make_run: MakeRun, make_row: MakeRow, plausible: Any) -> None:
    row = make_row(f"http/{HOSTILE}", plausible["http/binary"], 0, size=HOSTILE)
    manifest = {
        "argv": ["x", "latency", "--prompt", HOSTILE],
        "environment": {"cpu": HOSTILE, HOSTILE: 1},
        "warnings": [{"code": HOSTILE, "message": HOSTILE, "advice": HOSTILE}],
        "host": HOSTILE,
    }
    run = make_run({}, manifest=manifest, extra=(row,))
    text = page_of(run.path)
    page = Page(text)
    assert page.tags["script"] == 1
    assert "<script>alert" not in text
    assert HOSTILE in page.text
    assert f"http/{HOSTILE}" in page.cells


def test_the_command_can_be_pasted_into_a_shell(make_run: MakeRun) -> None:
    argv = ["/somewhere/__main__.py", "latency", "--prompt", 'it\'s "one" $HOME', "--runs", "3"]
    page = Page(page_of(make_run({}, manifest={"argv": argv}).path))
    command = next(line for line in page.text.splitlines() if line.startswith("s2a-bench latency"))
    done = subprocess.run(["sh", "-c", f"printf '%s\\n' {command}"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["s2a-bench", *argv[1:]]


def test_timelines_stand_in_the_page_where_they_were(computed: Path, shown: str) -> None:
    six, _ = page_lanes(timelines_of(read_run(computed))).panels
    assert six.title == "Jetson AGX Orin, 4.8 tokens/s: L = 6, N = 8, T_nom = 1 s"
    naive, wait, ours = six.lanes
    assert [bar.kind for bar in naive.bars] == ["skill", *["stall", "skill"] * 7]
    assert sum(bar.width_s for bar in naive.bars if bar.kind == "stall") == pytest.approx(1.75)
    assert [lane.start_s for lane in six.lanes] == pytest.approx([1.75, 10.5, 3.5])
    assert naive.bars[1].text == "naive: stall of 0.25 s before skill 2, 2.75 to 3.00 s"
    assert ours.bars[0].text == "stream-to-act: skill 1 arrives at 1.75 s, runs 3.50 to 4.50 s, no stall before it"
    assert (naive.summary, wait.summary) == (
        "starts 1.75 s, ends 11.50 s, 7 stalls, 1.75 s",
        "starts 10.50 s, ends 18.50 s, no stalls",
    )
    assert len(six.tokens_s) == 48
    page = Page(shown)
    assert shown.count('<rect class="skill"') == 2 * 3 * 8
    assert shown.count('<rect class="stall"') == 7
    assert naive.bars[1].text in shown  # without a script it is the browser's own tooltip
    assert page.values("tabindex")


def test_a_sweep_of_timelines_is_shown_as_the_one_run_that_it_amounts_to(tmp_path: Path) -> None:
    boards = ("rtx-4080", "jetson-agx-orin")
    cells = [
        (
            {"profile": board, "tokens-per-skill": tokens, "policy": policy},
            timeline(tmp_path, profiles=(board,), tokens_per_skill=(tokens,), policies=(policy,)),
        )
        for board, tokens, policy in product(boards, (6,), POLICIES)
    ]
    folder = sweep_of(tmp_path / "sweeps", cells)
    whole = read_run(timeline(tmp_path, profiles=boards, tokens_per_skill=(6,)))
    overview, pooled = read_chapters([folder])
    assert pooled.content.tables["timelines"] == replace(
        execution_table(timelines_of(whole), whole.manifest), provenance=whole.origins.line
    )
    assert pooled.content.csvs == timeline_csv(timelines_of(whole))
    assert pooled.run.origins == whole.origins
    assert pooled.content.lanes == page_lanes(timelines_of(whole))
    assert len(overview.content.tables["cells"].rows) == 6
    assert overview.content.sentences[0] == "6 of 6 cells of s2a-bench timeline are finished."
    page = Page(page_of(folder))
    assert "as it was" in page.text
    assert page.text.count("sweep on ") >= 2  # its title names the page


def test_cells_of_one_name_are_not_made_one(tmp_path: Path) -> None:
    same: dict[str, Any] = {"profiles": ("rtx-4080",), "tokens_per_skill": (6,)}
    folder = sweep_of(tmp_path / "sweeps", [({"n": n}, timeline(tmp_path, **same)) for n in (1, 2)])
    _, first, second = read_chapters([folder])
    assert first.content.tables == second.content.tables
    assert [len(chapter.content.lanes.panels[0].lanes) for chapter in (first, second)] == [3, 3]
    assert first.name != second.name


@pytest.mark.slow
def test_measured_cells_stand_side_by_side_and_are_not_pooled(tmp_path: Path, make_run: MakeRun) -> None:
    runs = [({"runs": n}, make_run(n=n).path) for n in range(2, MOST_CHAPTERS + 4)]
    folder = sweep_of(tmp_path / "sweeps", [*runs, ({"runs": 99}, tmp_path / "no-such")])
    overview, *chapters = read_chapters([folder])
    assert len(chapters) == MOST_CHAPTERS
    rows = overview.content.tables["overview"].rows
    assert len(rows) == len(runs) * 5
    assert [row[:5] for row in rows[:5:4]] == [
        ("runs 2", "http/as-deployed", "End to end without inference, ms", rows[0][3], "2"),
        ("runs 2", "loopback", "End to end without inference, ms", rows[0][3], "2"),
    ]
    assert "14 cells were run: the first 12" in overview.caveats[0]
    assert overview.content.tables["cells"].rows[-1][3] == "failed: no room"
    assert "1 failed" in overview.content.sentences[1]


@pytest.mark.parametrize(
    ("state", "error", "caveat"),
    [("running", None, "still running, or was killed"), ("failed", "the server died", "(failed: the server died)")],
)
def test_an_unfinished_run_is_shown_and_told(make_run: MakeRun, state: str, error: str | None, caveat: str) -> None:
    run = make_run(n=3)
    (run.path / "manifest.json").write_text(json.dumps({**run.manifest, "state": state, "error": error}))
    (chapter,) = read_chapters([run.path])
    assert caveat in chapter.caveats[0]
    assert state == "running" or caveat in Page(page_of(run.path)).text


def test_a_run_without_rows_is_told(make_run: MakeRun) -> None:
    (chapter,) = read_chapters([make_run({}).path])
    assert chapter.content.sentences == ("The run has no rows: it ended before anything was measured.",)


def test_rows_that_their_manifest_does_not_fit_fail_alone(computed: Path, tmp_path: Path) -> None:
    odd = shutil.copytree(computed, tmp_path / "odd")
    (odd / "manifest.json").write_text(json.dumps({**read_run(odd).manifest, "boards": [{"name": "x"}]}))
    chapters = read_chapters([odd, computed])
    assert chapters[0].content.failures
    assert not chapters[1].content.failures
    assert set(chapters[0].content.tables) < set(chapters[1].content.tables)


@pytest.mark.slow
def test_runs_of_unlike_machines_are_told_apart(make_run: MakeRun) -> None:
    runs = [make_run(n=2, manifest={"environment": {"cpu": cpu, "cores": 2}}).path for cpu in ("A", "B", "A")]
    report = make_report(read_chapters(runs))
    assert len(report.caveats) == 1
    assert "cpu: A against B" in report.caveats[0]
    assert report.caveats[0] in Page(page_of(*runs)).text


def test_another_version_or_setting_is_no_other_machine_and_one_line_for_all_runs(make_run: MakeRun) -> None:
    facts = {"environment": {"cpu": "A", "governor": "powersave", "packages": {"numpy": "1"}}, "tuning": {}}
    runs = []
    for place, governor in enumerate(("powersave", "performance", "performance")):
        facts["environment"] |= {"governor": governor, "packages": {"numpy": str(place)}}
        settings = {"configuration": {"seed": place}, "tuning": {"process": place > 0}}
        runs.append(make_run(n=2, manifest={**facts, **settings}).path)
    report = make_report(read_chapters(runs))
    caveat = "The runs differ in governor, tuning process, package numpy, configuration seed."
    assert report.caveats == [caveat]


def test_a_folder_given_twice_is_one_chapter(computed: Path) -> None:
    assert len(read_chapters([computed, computed / ".." / computed.name])) == 1


def test_every_verdict_has_its_evidence_on_the_page(computed: Path) -> None:
    text = page_of(computed, against="paper")
    page = Page(text)
    assert "AGX Orin: naive shows intermittent stalls" in page.text
    assert "Rule: At some L between 10 and 90 % of the gaps" in page.text
    assert "met, source: EMULATED after jetson-agx-orin, 4.8 tokens/s of table II" in page.text
    assert "Run: s2a-bench latency" in page.text
    for verdict in ("supported", "contradicted", "undecided"):
        assert f'class="claim {verdict}"' in text


def test_files_lie_in_a_folder_a_run(tmp_path: Path, computed: Path, make_run: MakeRun) -> None:
    runs = [computed, make_run(n=2).path]
    report = make_report(read_chapters(runs, against="paper"), against="paper")
    config = ReportConfig(runs=runs, latex=tmp_path / "tex", csv=tmp_path / "csv", markdown=tmp_path / "all.md")
    written = {str(path.relative_to(tmp_path)) for path in write_report(report, config)}
    one, other = (path.name for path in runs)
    assert {f"tex/{one}/timelines.tex", f"tex/{one}/timeline.pdf", f"tex/{other}/stages.tex"} <= written
    assert {"tex/report.tex", "tex/claims.tex", "csv/claims.csv", f"csv/{other}/ratios.csv", "all.md"} <= written
    assert (tmp_path / "tex" / one / "timeline.pdf").read_bytes().startswith(b"%PDF")
    markdown = (tmp_path / "all.md").read_text()
    assert "| Jetson AGX Orin | 6 | naive | 1.75 | 11.50 | 7 |" in markdown
    assert "## The paper's claims" in markdown


def test_the_provenance_of_every_cell_is_on_the_page_in_the_claims_and_in_csv(
    tmp_path: Path, computed: Path, beside: MakeRun
) -> None:
    replayed = replace(REAL, engine="replay", weights="none", tokens="emulated", profile="rtx-4080")
    cells = {"http/as-deployed": replayed, "ros/topic": replace(REAL, weights="dummy")}
    stages = {"convert": 10.0, "inference": 5.0, "return": 0.0}
    run = beside(dict.fromkeys(cells, stages), origins=cells).path
    report = make_report(read_chapters([run, computed], against="paper"), against="paper")
    page = tmp_path / "page.html"
    write_report(report, ReportConfig(runs=[run], output=page, csv=tmp_path / "csv"))

    codes = {name: each.code for name, each in cells.items()}
    claims = pd.read_csv(tmp_path / "csv" / "claims.csv")
    assert {*codes.values(), *read_run(computed).origins.code.split()} == set(claims["provenance"][0].split())
    rows = pd.read_csv(tmp_path / "csv" / run.name / "summary.csv")
    assert {name: set(rows.loc[rows["cell"] == name, "provenance"]) for name in codes} == {
        name: {code} for name, code in codes.items()
    }
    (basis,) = claims.loc[claims["claim"].str.startswith("HTTP/JSON"), "evidence"]
    assert f"Basis: {run.name}, 3 launches. Provenance: {'; '.join(each.line for each in cells.values())}." in basis
    article = page.read_text().partition("HTTP/JSON takes longer")[2].partition("</article>")[0]
    assert re.findall('class="label">(.*?)<', article) == ["emulated", "replay engine", "dummy weights"]
    heading = page.read_text().partition(f'<section id="run-{run.name}">')[2].partition("</h2>")[0]
    assert set(re.findall('class="label">(.*?)<', heading)) >= {"emulated", "replay engine", "dummy weights"}


def test_a_figures_caption_stands_with_it_on_the_page_and_in_latex(tmp_path: Path, computed: Path) -> None:
    chapters = read_chapters([computed])
    report = make_report(chapters)
    write_report(report, ReportConfig(runs=[computed], output=tmp_path / "page.html", latex=tmp_path / "tex"))
    with paper_column():
        title, *notes = caption_of(chapters[0].content.figures["timeline"]())
    assert any(note.startswith("EMULATED") for note in notes)
    page, tex = (tmp_path / "page.html").read_text(), (tmp_path / "tex" / "report.tex").read_text()
    assert f'role="img" aria-label="{title}, emulated, ' in page
    assert f"<figcaption><b>{title}</b>" in page
    assert all(note in unescape(page) for note in notes)
    assert f"\\caption{{{escape(' '.join((f'{title}.', *notes)))}}}\\end{{figure}}" in tex


def test_an_svg_for_html_has_no_addresses_and_ids_of_its_own() -> None:
    svg = (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" viewBox="0 0 1 1">'
        "<!-- a -- b --><style>*{a: b}</style>"
        '<metadata><x rdf="http://purl.org/"/></metadata><path id="p" d="M 1.2345 2 \nL 3 4" clip-path="url(#c)"/>'
        '<use xlink:href="#p"/></svg>'
    )
    assert inline(svg, "r-") == (
        '<svg viewBox="0 0 1 1"><path id="r-p" d="M 1.23 2L 3 4" clip-path="url(#r-c)"/><use href="#r-p"/></svg>'
    )


def test_a_float_has_title_notes_and_provenance_as_its_caption() -> None:
    table = TextTable(
        "T_nom",
        ("cell", "plain", "spread", "mixed"),
        [("a_b", "1.25", "10.5 ± 0.25", "3 [1.5, 4]"), ("c", ABSENT, "1 ± 0", "12%")],
        1,
        frozenset({1}),
        ("100 % & more",),
        "Provenance: dummy.",
    )
    text = to_float(table)
    assert r"\begin{tabular}{lrrr}" in text
    assert r"a\_b & 1.25 & 10.5 $\pm$ 0.25 & 3 [1.5, 4] \\" in text
    assert r"\caption{T\_nom. 100 \% \& more Provenance: dummy.}" in text
    assert text.count(r"\midrule") == 2
    assert r"\begin{tabular}{>{\raggedright\arraybackslash}p{60mm}rrr}" in to_float(table, ("60mm",))
    assert r"\begin{longtable}" in to_float(table, long=True)


@given(st.text())
def test_no_text_is_a_command_to_latex(text: str) -> None:
    escaped = escape(text)
    assert escaped.isprintable()
    left = re.sub(r"\\(text[a-z]+\{\}|[{}_%&#$])|\$\\?[a-z^0-9-]+\$", "", escaped)
    assert not set(left) & set("\\{}_%&#$^~<>|")


def test_a_chapter_of_another_command_is_named_and_not_guessed_at(make_run: MakeRun) -> None:
    run = make_run(n=2)
    (run.path / "manifest.json").write_text(json.dumps({**run.manifest, "command": "dance"}))
    (chapter,) = read_chapters([run.path])
    assert chapter.content.sentences[0].startswith("There is no view of dance runs; this one has samples (")
