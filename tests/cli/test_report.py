"""`s2a-bench report` as a user runs it."""

from __future__ import annotations

import re
import shutil
from html import unescape
from pathlib import Path

import pytest

from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from tests.cli.program import called, refused


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def timeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = TimelineComputed(profiles=("jetson-agx-orin",), tokens_per_skill=(6,))
    return run_timeline(config, tmp_path_factory.mktemp("timeline"), NullProgress())


def test_a_run_becomes_a_page_in_the_current_folder_and_again(timeline: Path, tmp_path: Path) -> None:
    for _ in range(2):
        done = called("report", timeline)
        assert done.stdout == "page: report.html\n"
        assert done.stderr == ""
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")


def test_what_is_asked_for_is_written_and_nothing_else(timeline: Path, tmp_path: Path) -> None:
    before = sorted(timeline.rglob("*"))
    done = called("report", timeline, "--latex", "tex", "--csv", "csv", "--markdown", "all.md", "--against", "paper")
    assert done.stdout.startswith("the paper's claims: ")
    assert "25 undecided or not testable, 2 identity, 1 supported, 1 contradicted" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"tex", "csv", "all.md"}
    assert sorted(timeline.rglob("*")) == before


def test_a_folder_is_all_runs_in_it_and_what_is_no_run_is_skipped(
    timeline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "results"
    started = read_run(timeline).manifest["started"]
    for name, day in (("a", 3), ("b", 2)):
        manifest = shutil.copytree(timeline, folder / name) / "manifest.json"
        manifest.write_text(manifest.read_text().replace(started, f"2026-01-0{day}T00:00:00+00:00"))
    (folder / "README.md").write_text("mine")
    (folder / "notes").mkdir()
    for paths in ([folder], sorted(folder.iterdir())):
        skipped = called("report", *paths).stderr.splitlines()
        assert [line.partition(" is not a run folder")[0] for line in skipped] == [
            f"skipped: {folder / name}" for name in ("README.md", "notes")
        ]
        page = Path("report.html").read_text()
        assert sorted(re.findall(r"<h2>.*, 2026-01-0(\d)", page)) == ["2", "3"]
    assert f"a folder that holds some, as {folder}" in refused("report", tmp_path, code=2)
    called("report", folder)
    assert re.findall(r"<h2>.*, 2026-01-0(\d)", Path("report.html").read_text()) == ["2", "3"]
    monkeypatch.setattr("s2a_bench.report.page.chapters.MOST_RUNS", 1)
    said = f"{folder} holds 2 runs: the latest 1 are used; name the folders of others"
    assert said in called("report", folder).stderr
    assert re.findall(r"<h1>.*, 2026-01-0(\d)", Path("report.html").read_text()) == ["3"]


def test_an_unfinished_run_is_told_on_standard_error(timeline: Path, tmp_path: Path) -> None:
    manifest = (timeline / "manifest.json").read_text()
    cut = shutil.copytree(timeline, tmp_path / "cut")
    (cut / "manifest.json").write_text(manifest.replace('"state": "finished"', '"state": "running"'))
    done = called("report", cut)
    assert "warning: timeline on" in done.stderr
    assert "has not finished" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["/no/such/folder"], 1, "error: /no/such/folder is not a run folder"),
        (["{here}", "{here}/mine.html"], 2, "error: no run folder: {here}, {here}/mine.html; name run folders"),
        (["{run}", "--against", "rivals"], 2, "--against: 'rivals' should be paper; two runs are compared with"),
        (["{run}", "--output", "{here}"], 2, "--output: {here} is a folder; name a file"),
        (["{run}", "--output", "{here}/mine.html"], 2, "s2a-bench report did not write it; name another file"),
        (["{run}", "--markdown", "{here}/mine.html"], 2, "--markdown: {here}/mine.html exists"),
        (["{run}", "--latex", "{here}/mine.html"], 2, "--latex: {here}/mine.html is a file; name a folder"),
        (["{run}", "--output", "/proc/nowhere/page.html"], 1, "cannot write /proc/nowhere/page.html"),
        ([], 2, "Missing argument"),
    ],
)
def test_wrong_use_is_one_line(timeline: Path, tmp_path: Path, arguments: list[str], code: int, message: str) -> None:
    (tmp_path / "mine.html").write_text("mine")
    filled = [each.format(here=tmp_path, run=timeline) for each in arguments]
    assert message.format(here=tmp_path) in refused("report", *filled, code=code)
    assert (tmp_path / "mine.html").read_text() == "mine"


SHOWN = "s2a_bench.experiments.timeline.view"


@pytest.mark.parametrize(
    ("broken", "what", "kept"),
    [
        (f"{SHOWN}.tables.skill_table", "table skills", "tables/motion.md"),
        (f"{SHOWN}.tables.timeline_csv", "csvs", "tables/motion.md"),
        (f"{SHOWN}.figures.new_figure", "figure timeline", "tables/motion.md"),
        ("s2a_bench.writers.csv_text.to_latex", "the tables' files", "figures/timeline.png"),
        (f"{SHOWN}.tables.timelines_json", "--json", "figures/timeline.png"),
    ],
)
def test_what_cannot_be_shown_is_one_line_and_the_rest_is_written(
    broken: str, what: str, kept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise KeyError("source")

    monkeypatch.setattr(broken, fails)
    small = ("--profile", "jetson-agx-orin", "--tokens-per-skill", "6", "--output", "runs")
    done = called("timeline", *small, *(["--json"] if what == "--json" else []), code=1)
    (run,) = Path("runs").iterdir()
    line = f"error: {what}: KeyError: 'source'; all else is written; once it is fixed, s2a-bench report {run} shows it"
    assert done.stderr.splitlines()[-1] == line
    assert (run / kept).exists()
    if what in {"--json", "the tables' files"}:
        return
    done = called("report", run, "--output", "page.html", "--csv", "csv", code=1)
    not_shown = f"Not shown: {what}: KeyError: 'source'."
    warning, error = done.stderr.splitlines()
    assert warning.endswith(not_shown)
    assert error == line.replace(str(run), str(run.resolve()))
    page = Path("page.html").read_text()
    assert "Waiting" in page
    assert not_shown in unescape(page)
    assert ("queue wait<" in page) == (what != "table skills")
    assert Path("csv").exists() == (what != "csvs")
    manifest = run / "manifest.json"  # an unfinished run may lack rows
    manifest.write_text(manifest.read_text().replace('"state": "finished"', '"state": "failed"'))
    done = called("report", run, "--output", "page.html", code=0)
    assert not_shown in done.stderr
    assert not_shown in unescape(Path("page.html").read_text())
