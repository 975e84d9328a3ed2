"""Provenance: declared by the source of numbers, kept in the manifest, and on everything that is written."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import pytest

import s2a_bench as s2a
from s2a_bench.boards.profile import to_toml
from s2a_bench.experiments import EXPERIMENTS, Shown, write_shown
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.provenance import SEEN, Origins, Provenance, joined
from s2a_bench.report.compare.agreement import differences
from s2a_bench.report.page import ReportConfig
from s2a_bench.report.page.chapters import read_chapters
from s2a_bench.report.page.files import make_report, write_report
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.figures import new_figure, save
from s2a_bench.writers.latex import to_float, to_latex
from s2a_bench.writers.tables import TextTable, to_markdown
from tests.made_bags import CAMERA, TOKENS, record, tokens

LLAMA = {"engine": "llama", "model": "/m/tiny.gguf", "name": "tiny", "dummy": True, "model_sha256": "ab"}


@pytest.mark.parametrize(
    ("facts", "line", "code", "labels"),
    [
        ({}, "engine UNKNOWN (the server does not report it)", "unknown/unknown/unknown", ("engine unknown",)),
        (LLAMA, "llama (tiny, DUMMY WEIGHTS), tokens measured", "llama/dummy/measured", ("dummy weights",)),
        (LLAMA | {"dummy": False}, "llama (tiny), tokens measured", "llama/real/measured", ()),
        (
            LLAMA | {"dummy": False, "pictures": "not seen"},
            "llama (tiny), tokens measured, PICTURE NOT SEEN",
            "llama/real/measured/pictures-not-seen",
            ("picture not seen",),
        ),
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
    found = Provenance.of_engine(facts, link="real")
    assert (found.line, found.code, found.labels) == (line, code, labels)
    assert Provenance.from_dict(found.to_dict()) == found


def test_a_run_of_before_there_were_text_models_saw_its_pictures() -> None:
    found = Provenance.of_engine(LLAMA, link="real")
    before = {name: value for name, value in found.to_dict().items() if name != "pictures"}
    assert Provenance.from_dict(before) == found
    assert Provenance.from_dict({**before, "pictures": "seen by someone"}).labels == found.labels


def test_what_a_peer_tells_is_bounded_and_has_the_right_types() -> None:
    found = Provenance.from_dict({"engine": "x" * 10**6, "weights": 3, "tokens": None, "other": "y", "model": ["z"]})
    assert len(found.engine) == 200
    assert (found.weights, found.tokens, found.model) == ("unknown", "unknown", "")


def test_every_field_but_the_clients_own_travels_over_ros() -> None:
    wire = pytest.importorskip("s2a_bench.transport.ros.wire")
    origin = Provenance.of_engine({**LLAMA, "pictures": "not seen", "quantisation": "F16"}, link="real")
    assert Provenance.from_dict(wire.provenance_of(wire.provenance_message(origin.to_dict()))) == origin


def test_a_replay_and_an_echo_say_what_they_are() -> None:
    replay = Provenance.of_engine(open_engine(EngineConfig(name="replay", profile="rtx-4080")).describe(), link="real")
    assert (replay.emulated, replay.profile, replay.labels) == (True, "rtx-4080", ("emulated", "replay engine"))
    assert replay.line == "replay (no model), tokens EMULATED after rtx-4080"
    echo = Provenance.of_engine(open_engine(EngineConfig(name="echo")).describe(), link="real")
    recorded_with_a_dummy = Provenance.of_engine({**LLAMA, "engine": "replay", "emulated": True})
    assert (replay.weights, recorded_with_a_dummy.weights) == ("none", "dummy")
    assert (echo.weights, echo.tokens, echo.labels) == ("none", "measured", ("echo engine",))


@pytest.mark.parametrize(
    ("written", "profile"),
    [("80", "latencies 80 ms"), ("lognormal:mean_ms=80,cv=5", "latencies lognormal:mean_ms=80,cv=5")],
)
def test_an_echo_whose_latencies_are_given_is_emulated(written: str, profile: str) -> None:
    echo = Provenance.of_engine(open_engine(EngineConfig(name="echo", latency=written)).describe(), link="real")
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


@pytest.mark.parametrize("write", [to_markdown, to_latex, to_float])
def test_no_table_is_written_without_it(write: Any) -> None:
    table = TextTable("T", ("a", "b"), [("1", "2")], 1)
    with pytest.raises(ValueError, match="does not say where its numbers come from"):
        write(table)


def test_no_figure_is_written_without_it(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not say where its numbers come from"):
        save(tmp_path, {"f": lambda: new_figure(1, "F")})


TWO = {"transports": ["loopback", "http/binary"], "size": "64x48", "requests": 3, "warmup": 1}
RUNS: dict[str, dict[str, Any]] = {
    "latency": {**TWO, "engine": "echo"},
    "throughput": {**TWO, "engine": "replay", "profile": "DUMMY", "max_tokens": 40},
    "timeline": {"profiles": ["rtx-4080", "DUMMY"], "tokens_per_skill": [6]},
    "boundary": {"profiles": ["rtx-4080", "DUMMY"], "tokens_per_skill": [6], "points": 5},
    "capacity": {
        "transports": ["loopback", "http/binary"],
        "size": "64x48",
        "closed_loop": True,
        "robots": 1,
        "seconds": 0.2,
        "settle": 0,
    },
    "ccrb": {"random": 2},
    "chunks": {"cycles": 100, "latency": ["40", "DUMMY"]},
    "task": {
        "robot": "gym?env=CartPole-v1&success=survival&picture=none",
        "engine": "echo",
        "action_dim": 1,
        "horizon": 1,
        "modes": "sync",
        "latency": ["0", "40"],
        "episodes": 1,
        "steps": 3,
    },
    "watch": {"mode": "bag", "bag": "BAG", "in_": CAMERA, "out": TOKENS},
}
"""A small run of each experiment, of two cells; DUMMY is a profile that was recorded with dummy weights."""
ACROSS = {"stages", "facts", "positions", "ratios"}
"""Tables with cells as columns, or pairs of them."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return experiment -> a run of it, made once."""
    folder = tmp_path_factory.mktemp("made")
    dummy = folder / "dummy.toml"
    facts = {"title": "A dummy", "origin": "measured", "tokens_per_s": 2000.0, "prompt_s": 0.005}
    dummy.write_text(to_toml({**facts, "gaps": {"family": "constant"}, "model": {"dummy": True}}))

    bag = record(folder / "bag", tokens())

    @cache
    def run(name: str) -> Path:
        given = json.loads(json.dumps(RUNS[name]).replace("DUMMY", str(dummy)).replace("BAG", str(bag)))
        path: Path = getattr(s2a, name)(output=folder, **given).path
        return path

    return run


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_every_table_of_the_library_says_it_in_a_line_and_row_by_row(
    name: str, made: Callable[[str], Path], tmp_path: Path
) -> None:
    path = tmp_path / "run"
    shutil.copytree(made(name), path)
    if "transports" in RUNS[name]:  # as if another's server had answered in the second cell
        manifest = json.loads((path / "manifest.json").read_text())
        manifest["provenance"]["cells"]["http/binary"] = Provenance().to_dict()
        (path / "manifest.json").write_text(json.dumps(manifest))
    run = s2a.load(path)
    origins = read_run(path).origins
    codes = {each.code for each in origins.every}
    assert len(codes) == 1 + (name not in {"ccrb", "task", "watch"})
    html = run._repr_html_()
    for table in {*run.tables, *(name.removesuffix(".csv") for name in run._shown.csvs)}:
        frame = run.table(table)
        assert frame.attrs[PROVENANCE] == origins.line, table
        assert set(frame[PROVENANCE]) == ({origins.code} if table in ACROSS and "cell" not in frame else codes), table
        assert table not in run._shown.main or html.count(escape(origins.line)) >= len(run._shown.main)
    for frame in (run.samples, run.all_samples, run.tokens):
        assert frame.attrs[PROVENANCE] == origins.line


def test_rows_of_a_comparison_have_that_of_their_cell(made: Callable[[str], Path]) -> None:
    run = s2a.load(made("timeline"))
    found = s2a.compare(run, run).table()
    assert [*found[PROVENANCE]] == [*map(read_run(run.path).origins.of_row, found["cell"])]
    assert found[PROVENANCE].nunique() == 2
    assert "DUMMY WEIGHTS" in found.attrs[PROVENANCE]


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_every_table_csv_figure_page_and_json_of_every_experiment_has_it(
    name: str, made: Callable[[str], Path], tmp_path: Path
) -> None:
    run = s2a.load(made(name))
    stored = read_run(run.path)
    assert all(each.known or each.tokens in SEEN for each in stored.origins.every)
    experiment = EXPERIMENTS[name]
    shown: Shown = experiment.show(stored)
    assert shown.tables
    write_shown(stored, replace(shown, figures={}))
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
    chapters = read_chapters([run.path])
    page, csvs = tmp_path / "page.html", tmp_path / "csv"
    write_report(make_report(chapters), ReportConfig(runs=[run.path], output=page, csv=csvs))
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
    unseen = Provenance.of_engine({**LLAMA, "dummy": False, "pictures": "not seen"})
    (found,) = (str(each) for each in differences(made(measured), made(unseen)) if each.fatal)
    assert found == "provenance pictures: seen against not seen"
