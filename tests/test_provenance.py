"""Provenance: declared by the source of numbers, kept in the manifest, and on everything that is written."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import pytest

import s2a_bench as s2a
from s2a_bench.experiments import EXPERIMENTS, Shown, write_shown
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.provenance import Origins, Provenance, joined
from s2a_bench.report.compare.agreement import differences
from s2a_bench.report.page import ReportConfig
from s2a_bench.report.page.chapters import read_chapters
from s2a_bench.report.page.files import make_report, write_report
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.figures import new_figure, save
from s2a_bench.writers.latex import to_latex, to_siunitx
from s2a_bench.writers.tables import TextTable, to_markdown

LLAMA = {"engine": "llama", "model": "/m/tiny.gguf", "name": "tiny", "dummy": True, "model_sha256": "ab"}


@pytest.mark.parametrize(
    ("facts", "line", "code", "labels"),
    [
        ({}, "engine UNKNOWN (the server does not report it)", "unknown/unknown/unknown", ("engine unknown",)),
        (LLAMA, "llama (tiny, DUMMY WEIGHTS), tokens measured", "llama/dummy/measured", ("dummy weights",)),
        (LLAMA | {"dummy": False}, "llama (tiny), tokens measured", "llama/real/measured", ()),
        (
            LLAMA | {"dummy": False, "paced_tokens_per_s": 5.0},
            "llama (tiny), tokens PACED",
            "llama/real/paced",
            ("paced",),
        ),
        ({"engine": "x", "model": "m"}, "x (m, weights unknown), tokens measured", "x/unknown/measured", ()),
    ],
)
def test_what_an_engine_tells_is_said_in_words_and_in_one(
    facts: dict[str, Any], line: str, code: str, labels: tuple[str, ...]
) -> None:
    found = Provenance.of_engine(facts)
    assert (found.line, found.code, found.labels) == (line, code, labels)
    assert Provenance.from_dict(found.to_dict()) == found


def test_what_a_peer_tells_is_bounded_and_has_the_right_types() -> None:
    found = Provenance.from_dict({"engine": "x" * 10**6, "weights": 3, "tokens": None, "other": "y", "model": ["z"]})
    assert len(found.engine) == 200
    assert (found.weights, found.tokens, found.model) == ("unknown", "unknown", "")


def test_a_replay_and_an_echo_say_what_they_are() -> None:
    replay = Provenance.of_engine(open_engine(EngineConfig(name="replay", profile="rtx-4080")).describe())
    assert (replay.emulated, replay.profile, replay.labels) == (True, "rtx-4080", ("emulated",))
    echo = Provenance.of_engine(open_engine(EngineConfig(name="echo")).describe())
    assert (echo.weights, echo.tokens, echo.labels) == ("none", "measured", ("echo engine",))


@pytest.mark.parametrize(
    ("written", "profile"),
    [("80", "latencies 80 ms"), ("lognormal:mean_ms=80,cv=5", "latencies lognormal:mean_ms=80,cv=5")],
)
def test_an_echo_whose_latencies_are_given_is_emulated(written: str, profile: str) -> None:
    echo = Provenance.of_engine(open_engine(EngineConfig(name="echo", latency=written)).describe())
    assert (echo.emulated, echo.profile, echo.labels) == (True, profile, ("emulated", "echo engine"))
    assert echo.line == f"echo (no model), tokens EMULATED after {profile}"


def test_a_run_knows_its_cells_and_what_is_made_of_all() -> None:
    known, unknown = Provenance.of_engine(LLAMA), Provenance()
    origins = Origins(known, {"a": known, "b": unknown})
    assert Origins.of_manifest({"provenance": origins.to_manifest()}) == origins
    assert (origins.of_row("a"), origins.of_row("b")) == (known.code, unknown.code)
    assert origins.of_row("") == f"{known.code} {unknown.code}"
    assert joined([Origins(known), Origins(unknown)]).every == (known, unknown)


def test_of_a_run_without_provenance_nothing_is_known() -> None:
    assert Origins.of_manifest({"model": {"engine": "echo", "model": "none"}}) == Origins(Provenance())


def test_boards_alike_but_for_the_profile_share_a_line() -> None:
    origins = Origins(Provenance.computed("a"), {name: Provenance.computed(name) for name in ("a", "b")})
    assert origins.line == "Provenance: no engine, tokens EMULATED after a, b, virtual time."


@pytest.mark.parametrize("write", [to_markdown, to_latex, to_siunitx])
def test_no_table_is_written_without_it(write: Any) -> None:
    table = TextTable("T", ("a", "b"), [("1", "2")], 1)
    with pytest.raises(ValueError, match="does not say where its numbers come from"):
        write(table)


def test_no_figure_is_written_without_it(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not say where its numbers come from"):
        save(tmp_path, {"f": lambda: new_figure(1, "F")})


RUNS: dict[str, dict[str, Any]] = {
    "latency": {"transports": ["loopback"], "engine": "echo", "requests": 3, "warmup": 1},
    "timeline": {"profiles": ["rtx-4080"], "tokens_per_skill": [6]},
    "boundary": {"profiles": ["rtx-4080"], "tokens_per_skill": [6], "rates": (1.0, 10.0)},
    "ccrb": {},
    "chunks": {"cycles": 100, "latency": ["40", "lognormal:mean_ms=80,cv=.5"]},
}


@pytest.mark.parametrize("name", ["latency", "timeline", "boundary", "ccrb", "chunks"])
def test_every_table_csv_figure_page_and_json_of_every_experiment_has_it(name: str, tmp_path: Path) -> None:
    run = getattr(s2a, name)(output=tmp_path, **RUNS[name])
    stored = read_run(run.path)
    assert all(each.known for each in stored.origins.every)
    experiment = EXPERIMENTS[name]
    shown: Shown = experiment.show(stored)
    assert shown.tables
    write_shown(stored, shown)
    line, codes = stored.origins.line, {each.code for each in stored.origins.every} | {stored.origins.code}
    for path in (run.path / "tables").iterdir():
        text = path.read_text()
        if path.suffix == ".csv":
            rows = list(csv.DictReader(io.StringIO(text)))
            assert {row[PROVENANCE] for row in rows} <= codes, path
        else:
            assert "rovenance: " in text, path
    for path in run.path.glob("*.csv"):
        if path.stem != "resources":
            assert {row[PROVENANCE] for row in csv.DictReader(io.StringIO(path.read_text()))} <= codes, path
    assert shown.json()["provenance"] == stored.origins.to_manifest()
    chapters = read_chapters([run.path], against_paper=False)
    page, csvs = tmp_path / "page.html", tmp_path / "csv"
    write_report(
        make_report(chapters, against_paper=False),
        ReportConfig(runs=[run.path], output=page, csv=csvs, latex=tmp_path / "tex"),
    )
    assert line.removesuffix(".") in page.read_text()
    for path in csvs.rglob("*.csv"):
        assert PROVENANCE in path.read_text().partition("\n")[0], path


def test_runs_of_unlike_provenance_differ_fatally(tmp_path: Path) -> None:
    def made(provenance: Provenance) -> StoredRun:
        with RunWriter.create(tmp_path, "latency", {"provenance": Origins(provenance).to_manifest()}) as writer:
            pass
        return read_run(writer.path)

    measured = Provenance.of_engine({**LLAMA, "dummy": False})
    emulated = Provenance.of_engine({"engine": "replay", "emulated": True, "dummy": False, "profile": "rtx-4080"})
    found = [str(each) for each in differences(made(measured), made(emulated)) if each.fatal]
    assert "provenance tokens: measured against emulated" in found
    assert not any(each.fatal for each in differences(made(measured), made(measured)))
    assert any(each.fatal for each in differences(made(measured), made(Provenance())))
