"""Runs to share: what stays in them, that nothing else leaves, and that a changed one is not read."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Iterator
from dataclasses import replace
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
from s2a_bench.report.export import HIDDEN, Words, check_folder, write_exports
from s2a_bench.store.export import KEY, WITHHELD
from s2a_bench.store.manifest import SWEEP
from s2a_bench.store.requests import TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.store.sweep import CELLS, CellRow
from tests.made_runs import MakeRun, row_of

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "docs/schema/s2a-bench-export-1.json").read_text())
REFERENCE = ROOT / "results/reference"
EMULATED = Provenance("echo", profile="rtx-4080", weights="dummy", tokens="paced", link="real")
MANIFEST: dict[str, Any] = {
    "argv": ["/home/alice/s2a-bench", "latency", "--url", "http://lab-gpu:8000"],
    "host": "lab-robot-7",
    "environment": {"host": "lab-robot-7", "cpu": "AMD EPYC", "cores": 2, "packages": {"opencv": "5.0.0.93"}},
    "configuration": {"url": "http://lab-gpu:8000", "prompt": "Tidy up.", "runs": 20, "mode": "request", "host": ""},
    "servers": {"http": {"address": "http://lab-gpu:8000", "pid": 7}},
    "seeds": {"order": 3, "nonce": "ab12"},
    "warnings": [{"code": "load", "message": "load of lab-robot-7: 2", "advice": "stop /home/alice/other"}],
    "provenance": Origins(EMULATED).to_manifest(),
}


def exported(run: StoredRun, folder: Path) -> StoredRun:
    """Export a run alone, and read it."""
    (path,) = write_exports([run.path], folder)
    return read_run(path)


def content(folder: Path) -> str:
    """Return the names and the bytes of all files below a folder."""
    return "".join(
        f"{path.relative_to(folder)}\n{path.read_text()}" for path in sorted(folder.rglob("*.*")) if path.is_file()
    )


@pytest.fixture
def run(make_run: MakeRun) -> StoredRun:
    """Make a run of three launches with a failed request."""
    failed = row_of("ros/topic", {}, 60, error="timeout of lab-gpu", marks=[])
    return make_run(n=30, launches=3, manifest=MANIFEST, extra=(failed,))


def test_an_export_keeps_every_row_with_its_launch_its_mark_as_warm_up_and_its_origin(
    run: StoredRun, tmp_path: Path
) -> None:
    other = exported(run, tmp_path / "shared")
    rows, kept = run.samples, other.samples
    assert rows.drop(columns="error").equals(kept.drop(columns="error"))
    assert kept["error"].tolist() == ["failed" if error else "" for error in rows["error"]]
    assert set(kept["launch"]) == {0, 1, 2}
    assert kept["warmup"].sum() == 25
    hidden = ["text", *HIDDEN]
    assert run.tokens.drop(columns=hidden).equals(other.tokens.drop(columns=hidden))
    assert not other.tokens["token_id"].notna().any()
    assert (other.origins, other.origins.labels) == (run.origins, ("dummy weights", "paced"))


def test_the_manifest_keeps_its_schema_and_says_what_it_withholds(run: StoredRun, tmp_path: Path) -> None:
    manifest = exported(run, tmp_path / "shared").manifest
    jsonschema.validate(manifest, SCHEMA)
    assert manifest["environment"] == {
        "host": WITHHELD,
        "cpu": "AMD EPYC",
        "cores": 2,
        "packages": {"opencv": "5.0.0.93"},
    }
    assert manifest["configuration"] == {
        "url": WITHHELD,
        "prompt": "withheld, SHA-256 b246a1d1e6bde76b",
        "runs": 20,
        "mode": "request",
        "host": "",
    }
    assert (manifest["seeds"], manifest["warnings"][0]["code"]) == ({"order": 3, "nonce": "ab12"}, "load")
    assert {"argv", "host", "servers"}.isdisjoint(manifest)


def test_a_run_compared_with_its_export_has_not_changed(run: StoredRun, tmp_path: Path) -> None:
    other = exported(run, tmp_path / "shared")
    assert differences(run, other) == []
    table = s2a_bench.compare(run.path, other.path, metrics=["all"]).table()
    assert (table["difference"] == 0).all()
    assert set(table["cell"]) == set(run.samples["cell"])


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
    assert "vm" not in content(tmp_path).replace('"', ",").split(",")


def test_two_exports_are_equal_byte_by_byte(run: StoredRun, tmp_path: Path) -> None:
    for name in ("one", "two", "two"):
        check_folder(tmp_path / name)
        write_exports([run.path, run.path], tmp_path / name)
    assert content(tmp_path / "one") == content(tmp_path / "two")
    (folder,) = (tmp_path / "one").iterdir()
    assert folder.name == f"{run.manifest['started'][:19].replace('-', '').replace(':', '')}Z-latency"


def test_an_export_of_an_export_is_the_same(run: StoredRun, tmp_path: Path) -> None:
    exported(exported(run, tmp_path / "one"), tmp_path / "two")
    assert content(tmp_path / "one") == content(tmp_path / "two")


SHARED = [
    path.parent
    for path in sorted((ROOT / "results/reference").glob("**/manifest.json"))
    if KEY in json.loads(path.read_text())
]


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
            folder = shutil.move(run.path, sweep.path / str(place))
            row = CellRow(str(place), 0, 1, "finished", "", False, "", "lab-robot-7", {}, [], "", folder.name, "", 1.0)
            sweep.append(CELLS, [replace(row, state="failed" if place == 2 else "finished")])
    folders = write_exports([sweep.path], tmp_path / "shared")
    assert [read_run(folder).manifest["configuration"]["place"] for folder in folders] == [0, 1]
    assert len(set(folders)) == 2


def test_servers_at_two_addresses_stay_two_cells(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "latency", MANIFEST) as run:
        for block in range(4):
            run.sample(row_of(f"http?url=http://10.0.0.{block % 2}:8000", {"capture": 1, "return": 1}, block))
    cells = exported(read_run(run.path), tmp_path / "shared").samples["cell"]
    assert [cells[0], cells[1]] * 2 == [*cells]
    assert cells.nunique() == 2


def test_a_line_end_in_a_text_stays_in_its_row(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "latency", MANIFEST) as run:
        run.sample(row_of('a "b",\r\nc\r', {"capture": 1, "return": 1}, 1))
    assert [*exported(read_run(run.path), tmp_path / "shared").samples["cell"]] == ['a "b",\r\nc\r']


def test_a_host_named_like_a_word_of_the_harness_changes_no_cell(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(n=2, manifest={**MANIFEST, "host": "ros", "environment": {"host": "network"}})
    assert exported(run, tmp_path / "shared").samples["cell"].equals(run.samples["cell"])


# What never leaves ----------------------------------------------------------------------------------------------------

LEAKS = ("lab-robot-7", "hal9", "alice", "10.1.2.3", "gpu-box", "/data", "secret.gguf", "fe80::1", "/home", "\\users")
"""What is in a planted text and must not leave: two hosts of the manifest, a user, addresses, another host, paths."""
PLANTED = st.sampled_from(
    [
        *(
            "lab-robot-7",
            "hal9",
            "LAB-ROBOT-7.local",
            "/home/alice",
            "/home/alice/my runs/x.csv",
            "C:\\Users\\alice\\x",
        ),
        *("~alice/x", "~/x of alice", "alice@gpu-box", "alice@10.1.2.3:/data", "http://alice:pw@gpu-box:8000/v1?a=b"),
        *("10.1.2.3", "10.1.2.3:8000", "fe80::1", "../secret.gguf", "models/secret.gguf", "/data/secret.gguf"),
    ]
)
AROUND = st.text(st.sampled_from(" .,;:=()[]?&|_-\n"), min_size=1, max_size=3)
PARTS = st.tuples(AROUND, st.one_of(PLANTED, st.sampled_from(["OLD", "x1", "3.5"]))).map("".join)
TEXTS = st.lists(PARTS, min_size=1, max_size=4).map("".join).map(str.strip)
"""Texts, with the old one at OLD."""


def planted(value: Any, texts: Iterator[str], *, keep: tuple[str, ...] = ("schema", "state")) -> Any:
    """Return JSON with other texts, and with other keys where they are data."""
    if isinstance(value, dict):
        return {
            key if key in keep or key.isidentifier() else next(texts).replace("OLD", key): item
            if key in keep
            else planted(item, texts)
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [planted(item, texts) for item in value]
    return next(texts).replace("OLD", value) if isinstance(value, str) else value


RICH = json.loads((REFERENCE / "bench-llama/manifest.json").read_text()) | {
    name: json.loads((REFERENCE / folder / "manifest.json").read_text())[name]
    for folder, names in {"timeline-live": ["executions", "live"], "chunks-live": ["robot"]}.items()
    for name in names
}


@settings(deadline=None)
@given(texts=st.lists(TEXTS, min_size=1, max_size=3))
def test_no_place_and_no_name_stays_in_a_text(texts: list[str]) -> None:
    words = Words({"host": "lab-robot-7", "environment": {"host": "hal9"}, "argv": ["/home/alice/x", *texts]})
    for cleaned in (words.cleaned(text) for text in texts):
        assert [piece for piece in LEAKS if piece in cleaned.lower()] == []
        assert words.cleaned(cleaned) == cleaned


@settings(max_examples=8, deadline=None)
@given(texts=st.lists(TEXTS, min_size=5, max_size=20))
@example(texts=["OLD lab-robot-7 /home/alice"])
@example(texts=["10.1.2.3"])
def test_a_host_a_user_or_a_path_in_any_text_does_not_leave(
    texts: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    tmp_path = tmp_path_factory.mktemp("planted")

    def endless() -> Iterator[str]:
        while True:
            yield from texts

    text = endless()
    manifest = planted(RICH, text) | {"host": "lab-robot-7"}
    manifest["environment"]["host"] = "hal9"
    manifest["environment"]["packages"] = {"numpy": f"2.4{next(text)}", next(text): "1.0"}
    manifest["configuration"]["user"] = "/home/alice"
    with RunWriter.create(tmp_path, "latency", {}) as run:
        for block in range(3):
            row = row_of("ros/topic", {"capture": 1, next(text): 2, "return": 1}, block)
            names = ("cell", "pipeline", "variant", "payload", "connection", "engine", "mode", "size", "request_id")
            wrong = {name: next(text).replace("OLD", getattr(row, name)) for name in (*names, "error")}
            row = replace(row, **wrong, facts={next(text): 1.0})
            run.sample(row)
            run.tokens([TokenRow(row.request_id, row.cell, 0, 1, next(text), None, 5)])
    (run.path / "manifest.json").write_text(json.dumps(manifest))
    (run.path / "lab-robot-7.csv").write_text("provenance\nmeasured\n")
    (run.path / "alice.csv").write_text("lab-robot-7,provenance\n1,measured\n")
    (folder,) = write_exports([run.path], tmp_path / "shared")
    whole = content(tmp_path / "shared").lower()
    assert [piece for piece in LEAKS if piece in whole] == []
    assert len(read_run(folder).samples) == 3
    jsonschema.validate(read_run(folder).manifest, SCHEMA)


def test_the_names_of_this_machine_and_its_user_do_not_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_run: MakeRun
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "hal9.lab.example")
    monkeypatch.setenv("LOGNAME", "alice")
    run = make_run({"hal9 by alice_2": {"capture": 1, "return": 1}}, n=2)
    assert set(exported(run, tmp_path / "shared").samples["cell"]) == {"withheld-1 by withheld-2_2"}


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


def test_a_damaged_run_is_named(run: StoredRun, tmp_path: Path) -> None:
    path = run.path / "samples.parquet"
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(StoreError, match=f"^{path} is damaged"):
        write_exports([run.path], tmp_path / "shared")


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
