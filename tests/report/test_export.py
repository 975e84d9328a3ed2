"""Runs to share: what stays in them, that nothing else leaves, and that a changed one is not read."""

from __future__ import annotations

import json
import re
import shutil
import socket
from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import s2a_bench
from s2a_bench.errors import StoreError, UsageError
from s2a_bench.experiments import experiment_of
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.report.compare.agreement import differences
from s2a_bench.report.export import HIDDEN, Filter, check_folder, write_exports
from s2a_bench.store.export import KEY
from s2a_bench.store.manifest import SWEEP
from s2a_bench.store.requests import TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.store.sweep import CELLS, CellRow
from tests.made_runs import MakeRun, row_of

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "docs/schema/s2a-bench-export-1.json").read_text())
REFERENCE = ROOT / "results/reference"
EMULATED = Provenance("echo", profile="rtx-4080", weights="dummy", tokens="paced", link="real")
ENDS = {"capture": 1, "return": 1}
MANIFEST: dict[str, Any] = {
    "argv": ["/home/alice/s2a-bench", "latency", "--url", "http://al:pw@gpu-box:8000"],
    "host": "lab-robot-7",
    "environment": {"host": "lab-robot-7", "cpu": "AMD EPYC", "cores": 2, "packages": {"opencv": "5.0.0.93"}},
    "configuration": {"url": "http://gpu-box:8000", "prompt": "Tidy up.", "runs": 20, "mode": "request"},
    "servers": {"http": {"address": "http://gpu-box:8000", "pid": 7}},
    "seeds": {"order": 3, "nonce": "ab12"},
    "warnings": [{"code": "load", "message": "load of lab-robot-7: 2", "advice": "stop /home/alice/other"}],
    "provenance": Origins(EMULATED).to_manifest(),
}
EXPORTED: dict[str, Any] = {
    "environment": MANIFEST["environment"] | {"host": "withheld"},
    "configuration": MANIFEST["configuration"] | {"url": "withheld", "prompt": "withheld, SHA-256 b246a1d1e6bde76b"},
    "seeds": MANIFEST["seeds"],
    "warnings": [{"code": "load", "message": "withheld", "advice": "withheld"}],
    "provenance": MANIFEST["provenance"],
}


def exported(run: StoredRun, folder: Path) -> StoredRun:
    """Export a run alone, and read it."""
    (path,) = write_exports([run.path], folder)
    return read_run(path)


def listed(texts: str) -> list[str]:
    """Return texts that are separated by bars and lines."""
    return re.split(r"[|\n]", texts.strip())


def content(folder: Path) -> str:
    """Return the names and the bytes of all files below a folder."""
    files = (path for path in sorted(folder.rglob("*.*")) if path.is_file())
    return "".join(f"{path.relative_to(folder)}\n{path.read_text()}" for path in files)


@pytest.fixture
def run(make_run: MakeRun) -> StoredRun:
    """Make a run of three launches with a failed request."""
    failed = row_of("ros/topic", {}, 60, error="timeout of gpu-box", marks=[])
    return make_run(n=30, launches=3, manifest=MANIFEST, extra=(failed,))


def test_an_export_has_every_row_what_identifies_nothing_and_no_difference(run: StoredRun, tmp_path: Path) -> None:
    other = exported(run, tmp_path / "shared")
    rows, kept = run.samples, other.samples
    assert rows.drop(columns="error").equals(kept.drop(columns="error"))
    assert kept["error"].tolist() == ["failed" if error else "" for error in rows["error"]]
    assert run.tokens.drop(columns=HIDDEN).equals(other.tokens.drop(columns=HIDDEN))
    assert (other.origins, other.origins.labels) == (run.origins, ("dummy weights", "paced"))
    jsonschema.validate(other.manifest, SCHEMA)
    assert {name: other.manifest[name] for name in EXPORTED} == EXPORTED
    assert {"argv", "host", "servers"}.isdisjoint(other.manifest)
    assert differences(run, other) == []
    table = s2a_bench.compare(run.path, other.path, metrics=["all"]).table()
    assert (table["difference"] == 0).all()
    assert set(table["cell"]) == set(rows["cell"])


@pytest.mark.parametrize("name", ["bench-llama", "ccrb-live", "chunks-live", "timeline-live"])
def test_an_export_of_a_reference_run_shows_what_the_run_shows(name: str, tmp_path: Path) -> None:
    run = read_run(REFERENCE / name)
    other = exported(run, tmp_path)
    jsonschema.validate(other.manifest, SCHEMA)
    experiment = experiment_of(run.manifest["command"])
    assert experiment is not None
    shown, again = experiment.show(run), experiment.show(other)
    assert again.failures == []
    assert again.sentences == shown.sentences
    assert (again.figures.keys(), again.tables.keys()) == (shown.figures.keys(), shown.tables.keys())
    for csv, table in shown.csvs.items():
        assert again.csvs[csv].text(other.origins) == table.text(run.origins)


def test_exports_of_a_run_and_of_an_export_are_equal_byte_by_byte(run: StoredRun, tmp_path: Path) -> None:
    for name in ("one", "two", "two"):
        check_folder(tmp_path / name)
        write_exports([run.path, run.path], tmp_path / name)
    assert content(tmp_path / "one") == content(tmp_path / "two")
    (folder,) = (tmp_path / "one").iterdir()
    assert folder.name == f"{run.manifest['started'][:19].replace('-', '').replace(':', '')}Z-latency"
    assert content(exported(read_run(folder), tmp_path / "again").path) == content(folder)


SHARED = [path.parent for path in sorted(REFERENCE.glob("**/manifest.json")) if KEY in json.loads(path.read_text())]


@pytest.mark.parametrize("folder", SHARED, ids=lambda path: str(path.relative_to(REFERENCE)))
def test_a_reference_result_of_others_is_an_export_as_it_was_written(folder: Path, tmp_path: Path) -> None:
    """What docs/share.md promises of every folder that a pull request adds."""
    again = exported(read_run(folder), tmp_path)
    jsonschema.validate(again.manifest, SCHEMA)
    assert again.manifest["state"] == "finished"
    assert content(again.path) == content(folder)


def test_a_sweep_is_exported_as_its_finished_runs(make_run: MakeRun, tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, SWEEP, {"configuration": {"command": "latency"}}, (CELLS,)) as sweep:
        for place in range(3):
            run = make_run(n=2, manifest={**MANIFEST, "configuration": {"place": place}})
            folder = Path(shutil.move(run.path, sweep.path / str(place)))
            row = CellRow(str(place), 0, 1, "finished", "", False, "", "lab-robot-7", {}, [], "", folder.name, "", 1.0)
            sweep.append(CELLS, [replace(row, state="failed" if place == 2 else "finished")])
    folders = write_exports([sweep.path], tmp_path / "shared")
    assert [read_run(folder).manifest["configuration"]["place"] for folder in folders] == [0, 1]
    assert len(set(folders)) == 2


# What never leaves ----------------------------------------------------------------------------------------------------


def test_a_withheld_cell_has_one_name_in_every_table_and_in_the_manifest(tmp_path: Path) -> None:
    cells = [f"http?url=http://10.0.0.{place}:8000" for place in range(2)]
    origins = Origins(EMULATED, {cells[1]: EMULATED}).to_manifest()
    with RunWriter.create(tmp_path, "latency", {**MANIFEST, "provenance": origins}) as run:
        for block in range(4):
            row = row_of(cells[block % 2], ENDS, block)
            run.sample(row)
            run.tokens([TokenRow(row.request_id, row.cell, 0, 1, "7", None, 5)])
    other = exported(read_run(run.path), tmp_path / "shared")
    assert [*other.origins.cells] == ["withheld-1"]
    assert [*other.samples["cell"]] == [*other.tokens["cell"]] == ["withheld-2", "withheld-1"] * 2
    assert other.samples["request_id"].equals(other.tokens["request_id"])
    assert (other.tokens["text"] == "").all()
    assert other.tokens["token_id"].isna().all()


LEAVES = r"""
http/as-deployed?payload=jpeg|websocket/openpi|zmq/gr00t?layout=n1.6|ros?domain_id=7|stalled=1%|AMD EPYC|°C|m/s²|cpu
aggregate?trigger=6 @ ros/topic, uniform-20-200.csv|4.8tps/L6/N8/T0.8/stop/naive|2026-11-29T09:07:46+00:00|withheld-3
Intel(R) Core(TM) i9 CPU @ 3.60GHz|6.18.44-fc-v669|[["",12],["capture",-1.5e-3]]|{"payload_bytes":921912}|16 of 7
"""
STAYS = r"""
10.1.2.3|10.1.2.3:8000|fe80::1|00:1b:44:11:3a:b7|http://a/v1|bob@a|/data|../x|~/x|~bob|C:\x|\\nas\x|models/x.gguf
home/bob/x|http?url=gpu|ros/topic?namespace=arm|http?payload=jpeg&host=gpu|{"a":"x y"}|["a/b"]|[["a",1]]]@|$HOME
x?served-model=y|lab-robot-7|by LAB-ROBOT-7.local|x_lab-robot-7|alice's|gpu-box|hal9|of hal9.lab.example|carol_2
"""


def test_a_text_without_a_name_leaves_in_a_closed_form_else_nothing_of_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "hal9.lab.example")
    monkeypatch.setenv("LOGNAME", "carol")
    share = Filter(MANIFEST | {"environment": {"host": "ros"}})  # a word of the harness, too
    for text in listed(LEAVES):
        assert share.text(text) == text
    placeholders = [f"withheld-{number}" for number in range(1, len(listed(STAYS)) + 1)]
    assert [*map(share.text, listed(STAYS))] == [*map(share.text, listed(STAYS))] == placeholders


LEAKS = ("lab-robot-7", "hal9", "alice", "10.1.2.3", "gpu-box", "/data", "secret.gguf", "fe80::1", "/home", "\\users")
"""What is in a planted text and must not leave: two hosts of the manifest, a user, addresses, another host, paths."""
PLANTED = r"""
lab-robot-7|hal9|LAB-ROBOT-7.local|/home/alice|/home/alice/my runs/x.csv|C:\Users\alice\x|~alice/x|~/x of alice|alice
alice@gpu-box|alice@10.1.2.3:/data|http://alice:pw@gpu-box:8000/v1?a=b|10.1.2.3|10.1.2.3:8000|fe80::1|../secret.gguf
models/secret.gguf|/data/secret.gguf|OLD|x1|3.5
"""
AROUND = st.text(st.sampled_from(" .,;:=()[]?&|_-\n"), min_size=1, max_size=3)
PARTS = st.tuples(AROUND, st.sampled_from(listed(PLANTED))).map("".join)
TEXTS = st.lists(PARTS, min_size=1, max_size=4).map("".join).map(str.strip)
"""Texts, with the old one at OLD."""


def planted(value: Any, texts: Iterator[str]) -> Any:
    """Return JSON with other texts, and with other keys where they are data."""
    if isinstance(value, dict):
        keys = [key if key.isidentifier() else next(texts).replace("OLD", key) for key in value]
        kept = {key: item for key, item in value.items() if key in {"schema", "state"}}
        return {key: planted(item, texts) for key, item in zip(keys, value.values(), strict=True)} | kept
    if isinstance(value, list):
        return [planted(item, texts) for item in value]
    return next(texts).replace("OLD", value) if isinstance(value, str) else value


RICH = json.loads((REFERENCE / "bench-llama/manifest.json").read_text()) | {
    name: json.loads((REFERENCE / folder / "manifest.json").read_text())[name]
    for folder, name in (("timeline-live", "executions"), ("timeline-live", "live"), ("chunks-live", "robot"))
}


@settings(max_examples=8, deadline=None)
@given(texts=st.lists(TEXTS, min_size=5, max_size=20))
@example(texts=["OLD lab-robot-7 /home/alice"])
@example(texts=["10.1.2.3"])
def test_a_host_a_user_or_a_path_in_any_text_does_not_leave(
    texts: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    tmp_path, text = tmp_path_factory.mktemp("planted"), cycle(texts)
    manifest = planted(RICH, text) | {"host": "lab-robot-7"}
    manifest["environment"]["host"] = "hal9"
    manifest["environment"]["packages"] = {"numpy": f"2.4{next(text)}", next(text): "1.0"}
    manifest["configuration"] |= {"user": "/home/alice", "url": "http://gpu-box:8000"}
    with RunWriter.create(tmp_path, "latency", {}) as run:
        for block in range(3):
            row = row_of("ros/topic", {"capture": 1, next(text): 2, "return": 1}, block)
            names = ("cell", "pipeline", "variant", "payload", "connection", "engine", "mode", "size", "request_id")
            wrong: dict[str, Any] = {name: next(text).replace("OLD", getattr(row, name)) for name in (*names, "error")}
            row = replace(row, **wrong, facts={next(text): 1.0})
            run.sample(row)
            run.tokens([TokenRow(row.request_id, row.cell, 0, 1, next(text), None, 5)])
    (run.path / "manifest.json").write_text(json.dumps(manifest))
    (run.path / "lab-robot-7.csv").write_text("provenance\nmeasured\n")
    (run.path / "alice.csv").write_text("lab-robot-7,provenance\n1,measured\n")
    shared = exported(read_run(run.path), tmp_path / "shared")
    whole = content(tmp_path / "shared").lower()
    assert [piece for piece in LEAKS if piece in whole] == []
    assert [isinstance(json.loads(text), list) for text in shared.samples["marks"]] == [True] * 3
    assert content(exported(shared, tmp_path / "again").path) == content(shared.path)


# What is refused ------------------------------------------------------------------------------------------------------


def test_a_changed_missing_or_added_table_is_named_when_the_folder_is_read(run: StoredRun, tmp_path: Path) -> None:
    folder = exported(run, tmp_path / "shared").path
    samples = folder / "samples.csv"
    before = samples.read_bytes()
    for data in (before.replace(b"topic", b"tapic"), before[:-1], b""):
        samples.write_bytes(data)
        with pytest.raises(StoreError, match=rf"^{samples} has changed since its export"):
            s2a_bench.load(folder)
    samples.unlink()
    with pytest.raises(StoreError, match=f"^cannot read {samples}"):
        read_run(folder)
    samples.write_bytes(before)
    assert len(s2a_bench.load(folder).all_samples) == len(run.samples)
    (folder / "samples.parquet").write_bytes(b"")
    with pytest.raises(StoreError, match=f"^{folder / 'samples.parquet'} is not among the files of"):
        read_run(folder)
    (run.path / "samples.parquet").write_bytes(b"")
    with pytest.raises(StoreError, match=f"^{run.path / 'samples.parquet'} is damaged"):
        write_exports([run.path], tmp_path / "shared")


@pytest.mark.parametrize(
    ("export", "message"),
    [
        (None, "export: Input should be a dictionary or an instance of Export"),
        ({"schema": "s2a-bench-export/2", "files": {}}, "export.schema: Input should be 's2a-bench-export/1'"),
        ({"schema": "s2a-bench-export/1", "files": {"../x.csv": {"bytes": 1, "sha256": ""}}}, "x.csv is not among"),
    ],
)
def test_an_export_of_another_kind_is_refused(run: StoredRun, tmp_path: Path, export: Any, message: str) -> None:
    path = exported(run, tmp_path / "shared").path / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"export": export}))
    with pytest.raises(StoreError, match=message):
        read_run(path.parent)


def test_a_folder_with_anything_else_is_refused_and_so_is_the_run_itself(run: StoredRun, tmp_path: Path) -> None:
    check_folder(tmp_path / "new")
    folder = exported(run, tmp_path / "shared").path
    check_folder(folder.parent)
    with pytest.raises(UsageError, match=rf"^`export`: {folder} has manifest.json, which no export wrote"):
        check_folder(folder)
    with pytest.raises(UsageError, match=r"is the run itself"):
        write_exports([folder], folder.parent)
    (folder.parent / "notes").mkdir()
    with pytest.raises(UsageError, match="has notes, which no export wrote"):
        check_folder(folder.parent)
    with pytest.raises(UsageError, match=r"manifest.json is a file; name a folder"):
        check_folder(folder / "manifest.json")
