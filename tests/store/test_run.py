import errno
import json
import math
import os
import re
import socket
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from io import FileIO
from pathlib import Path
from shutil import rmtree
from types import SimpleNamespace

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from s2a_bench.errors import MissingExtra, StoreError
from s2a_bench.store import manifest as manifests
from s2a_bench.store.files import RESERVE, RESERVE_BYTES, read_csv, read_parquet, to_pandas, why
from s2a_bench.store.requests import TOKENS, FrameRow, SampleRow, TokenRow, frames_table, samples_table
from s2a_bench.store.run import RunWriter, StoredRun, fits, read_run
from s2a_bench.store.schema import PROVENANCE
from tests.made_runs import STAGES, row_of

CHAIN = [
    ("", 1_000),
    ("capture", 1_100),
    ("", 1_150),
    ("cdr_pack", 1_350),
    ("network", 2_350),
    ("inference", 12_350),
    ("return", 12_850),
]


def sample(request_id: str = "r1", **facts: object) -> SampleRow:
    measured = {
        "marks": CHAIN,
        "payload_bytes": 921_600,
        "n_tokens": 3,
        "last_token_ns": 13_000,
        "server_prompt_ms": 0.1,
    }
    whole = {"request_id": request_id, "facts": {"load": 0.30000000000000004}, **measured, **facts}
    return row_of("ros/topic", {}, 0, **whole)


def token(index: int, text: str, engine_ns: int | None = 5) -> TokenRow:
    return TokenRow("r1", "ros/topic", index, 100 + index, text, engine_ns, 9_007_199_254_740_993)


def kept(folder: Path, *samples: SampleRow) -> StoredRun:
    """Keep samples in a run that finishes, and read it."""
    with RunWriter.create(folder, "latency", {"stages": STAGES}) as run:
        for each in samples:
            run.sample(each)
    return read_run(run.path)


@pytest.fixture
def open_run(tmp_path: Path) -> Iterator[Callable[..., RunWriter]]:
    """Open runs that the test leaves unfinished."""
    runs: list[RunWriter] = []

    def create(root: Path = tmp_path) -> RunWriter:
        runs.append(RunWriter.create(root, "latency", {"stages": STAGES}))
        return runs[-1]

    yield create
    for run in runs:
        for _, file in run._files.values():
            file.close()


def test_a_finished_run_reads_back_as_it_was_written(tmp_path: Path) -> None:
    with RunWriter.create(
        tmp_path, "latency", {"stages": STAGES, "configuration": {"runs": 2}, "seeds": {"order": 3}}
    ) as run:
        run.sample(sample())
        run.tokens([token(0, "a")])
        run.update(environment={"cpu": "EPYC"}, configuration={"warmup": 1}, warnings=[{"code": "x"}])
    read = read_run(run.path)
    assert read.manifest["schema"] == "s2a-bench/1"
    assert read.manifest["command"] == "latency"
    assert read.manifest["state"] == "finished"
    assert read.manifest["configuration"] == {"runs": 2, "warmup": 1}
    assert read.manifest["environment"] == {"cpu": "EPYC"}
    assert read.manifest["seeds"] == {"order": 3}
    assert read.manifest["argv"] == sys.argv
    assert read.manifest["started"] <= read.manifest["finished"]
    row = read.samples.iloc[0]
    assert row["payload_bytes"] == 921_600
    assert row["server_prompt_ms"] == 0.1
    assert json.loads(row["marks"]) == [list(mark) for mark in CHAIN]
    assert json.loads(row["facts"]) == {"load": 0.30000000000000004}
    assert row["warmup"] == False  # noqa: E712 - a numpy bool
    assert read.tokens["client_ns"].tolist() == [9_007_199_254_740_993]
    assert read.frames.empty
    assert list(read.frames.columns) == list(frames_table(STAGES).columns)


def test_derived_columns_are_the_budget_of_the_chain(tmp_path: Path) -> None:
    row = kept(tmp_path, sample()).samples.iloc[0]
    expected = {"capture": 100, "cdr_pack": 200, "network": 1_000, "inference": 10_000, "return": 500, "residual": 50}
    expected |= {"e2e": 11_850, "e2e_without_inference": 1_850, "ttft": 11_750}
    assert {name: row[f"{name}_ns"] for name in expected} == expected
    assert row["residual_share"] == 50 / 1_850
    assert pd.isna(row["e2e_without_model_ns"])


def test_a_llama_servers_model_time_is_what_it_reports(tmp_path: Path) -> None:
    marks = [("", 0), ("capture", 2_000_000), ("ingest", 12_000_000), ("inference", 50_000_000)]
    model_ms = {"half": 30.0, "none": None, "more than there was": 51.0, "nothing": 0.0}
    rows = (sample(name, marks=marks, server_prompt_ms=prompt_ms) for name, prompt_ms in model_ms.items())
    samples = kept(tmp_path, *rows).samples
    assert samples["e2e_without_inference_ns"].tolist() == [12_000_000] * 4
    assert samples["e2e_without_model_ns"].iloc[0] == 20_000_000
    assert samples["e2e_without_model_ns"].iloc[1:].isna().all()


def test_an_absent_stage_is_null_and_one_that_took_no_time_is_zero(tmp_path: Path) -> None:
    at_once = [("", 5), ("capture", 5), ("inference", 5), ("return", 9)]
    samples = kept(tmp_path, sample(), sample(marks=at_once)).samples
    absent = [f"{stage}_ns" for stage in STAGES if stage not in dict(CHAIN)]
    assert len(absent) == len(STAGES) - 5
    assert samples[absent].isna().all(axis=None)
    assert pd.isna(samples["frame_age_ns"][0])
    assert samples["capture_ns"].tolist() == [100, 0]


def test_a_failed_sample_is_a_row_with_its_error_and_without_durations(tmp_path: Path) -> None:
    samples = kept(tmp_path, sample(error='refused: "no", 503\nretry'), sample("r2")).samples
    assert samples["error"].tolist() == ['refused: "no", 503\nretry', ""]
    derived = [*(f"{stage}_ns" for stage in STAGES), "e2e_ns", "ttft_ns", "residual_ns", "residual_share"]
    assert samples[derived].iloc[0].isna().all()
    assert samples["e2e_ns"].iloc[1] == 11_850


def test_a_sample_without_a_token_has_no_end_to_end(tmp_path: Path) -> None:
    assert pd.isna(kept(tmp_path, sample(marks=CHAIN[:-1], n_tokens=0)).samples["e2e_ns"][0])


@pytest.mark.parametrize("end", ["return", "ingest", "server"])
def test_where_nothing_is_captured_the_first_token_counts_from_the_start(tmp_path: Path, end: str) -> None:
    row = kept(tmp_path, sample(marks=[("", 100), ("network", 150), (end, 900)])).samples.iloc[0]
    assert (row["e2e_ns"], row["ttft_ns"]) == (800, 800)


def test_csv_and_parquet_hold_the_same_columns_and_values(tmp_path: Path) -> None:
    texts = [
        "plain",
        "",
        'qu"ote',
        "a,b",
        "line\nfeed",
        "return\r\n",
        "  spaces ",
        "NULL",
        "nan",
        "é漢\U0001f916",
        "\x00",
    ]
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as run:
        run.sample(sample())
        run.sample(sample("r2", error="x", server_prompt_ms=float("nan"), facts={"nan": float("nan")}))
        run.tokens(token(index, text, None if index % 2 else index) for index, text in enumerate(texts))
        run.frame(FrameRow("ros/topic", 3, 900, CHAIN[:4], "r1"))
    for table in (samples_table(STAGES), TOKENS, frames_table(STAGES)):
        csv = read_csv(run.path / f"{table.name}.csv", table.columns)
        parquet = read_parquet(run.path / f"{table.name}.parquet", table.columns)
        assert csv.column_names == [*parquet] == list(table.columns)
        pd.testing.assert_frame_equal(to_pandas(csv), parquet)
    read = read_run(run.path)
    assert read.tokens["text"].tolist() == texts
    assert read.tokens["engine_ns"].isna().tolist() == [index % 2 == 1 for index in range(len(texts))]
    assert pd.isna(read.samples["server_prompt_ms"][1])
    assert json.loads(read.samples["facts"][1]) == {"nan": None}


def test_frames_of_a_stream_have_a_budget_of_their_own(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as run:
        assert not (run.path / "frames.csv").exists()
        run.frame(FrameRow("ros/topic", 3, 900, CHAIN[:5], ""))
        run.frame(FrameRow("ros/topic", 4, 950, [], "r2"))
    frames = read_run(run.path).frames
    assert frames["network_ns"][0] == 1_000
    assert frames["path_ns"][0] == 1_350
    assert frames["latency_ns"][0] == 2_350 - 900
    assert frames["residual_ns"][0] == 50
    assert frames["path_ns"].isna().tolist() == [False, True]
    assert frames["used_by"].tolist() == ["", "r2"]


def test_a_torn_last_record_is_dropped(open_run: Callable[..., RunWriter]) -> None:
    run = open_run()
    run.sample(sample("r1"))
    run.sample(sample("r2"))
    run.tokens([token(0, "a\nb"), token(1, "c\nd,e")])
    samples, tokens = run.path / "samples.csv", run.path / "tokens.csv"
    whole = samples.read_bytes()
    last = whole.rindex(b"ros/topic,ros,")
    for size in (*range(last, len(whole), 11), len(whole) - 1):
        samples.write_bytes(whole[:size])
        assert read_run(run.path).samples["request_id"].tolist() == ["r1"]
    whole = tokens.read_bytes()
    tokens.write_bytes(whole[: whole.rindex(b"d,e")])  # inside quotation marks, after a line feed
    assert read_run(run.path).tokens["text"].tolist() == ["a\nb"]
    tokens.write_bytes(whole[:5])  # not even a header
    assert read_run(run.path).tokens.empty
    assert read_run(run.path).row_counts() == {"samples": 1}
    assert read_run(run.path).manifest["state"] == "running"


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("file", "`output` .*file.*is not a folder"),
        ("file/below", "`output` .*file.*is not a folder"),
        ("/proc/s2a", "`output` /proc/s2a: cannot create"),
    ],
)
def test_an_output_where_no_folder_can_be_is_refused_by_name(tmp_path: Path, where: str, message: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=message):
        RunWriter.create(tmp_path / where, "latency", {"stages": STAGES})


def test_a_folder_is_named_after_time_command_and_host_and_the_second_of_a_second_gets_a_2(
    tmp_path: Path, open_run: Callable[..., RunWriter], monkeypatch: pytest.MonkeyPatch
) -> None:
    noon = datetime(2026, 1, 2, 12, tzinfo=timezone.utc)
    monkeypatch.setattr("s2a_bench.store.run.datetime", SimpleNamespace(now={timezone.utc: noon}.get))
    names = []
    for host in ("orin", "orin", "orin", "a b/c!", "--", ""):
        monkeypatch.setattr(socket, "gethostname", lambda host=host: host)
        names.append(open_run(tmp_path / "new" / "results").path.name)
    stem = "20260102T120000Z-latency-"
    spelled = ["orin", "orin-2", "orin-3", "a-b-c", "unnamed", "unnamed-2"]
    assert names == [stem + name for name in spelled]


def test_an_output_without_write_permission_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(StoreError, match=f"`output` {tmp_path}: cannot create a folder there: permission denied"):
        RunWriter.create(tmp_path, "latency", {"stages": STAGES})


def test_a_disk_without_room_for_the_reserve_ends_the_run_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(folder: Path) -> None:
        (folder / RESERVE).touch()
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("s2a_bench.store.run.files.reserve", full)
    with pytest.raises(StoreError, match=f"cannot write into {tmp_path}: Input/output error"):
        RunWriter(tmp_path, {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", [ZeroDivisionError, AttributeError, KeyError, TypeError, ValueError])
def test_rows_that_do_not_fit_their_manifest_are_told_with_their_folders(wrong: type[Exception]) -> None:
    runs = [StoredRun(Path(name), {}) for name in ("one", "two")]
    message = rf"^one, two: rows and manifest do not fit: {wrong.__name__}\('x'\)$"
    with pytest.raises(StoreError, match=message), fits(*runs):
        raise wrong("x")


class FullDisk:
    """A file on a disk with room for ten more bytes."""

    def __init__(self, file: FileIO) -> None:
        self.room = 10
        self.file = file
        self.truncate, self.seek, self.close = file.truncate, file.seek, file.close

    def write(self, data: bytes) -> int:
        if not self.room:
            raise OSError(28, "No space left on device")
        written = self.file.write(data[: self.room])
        self.room -= written
        return written


def test_a_full_disk_names_the_file_and_leaves_whole_records(
    open_run: Callable[..., RunWriter], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = open_run()
    run.sample(sample("r1"))
    file = run._files["samples"][1]._file
    monkeypatch.setattr(run._files["samples"][1], "_file", FullDisk(file))
    with pytest.raises(StoreError, match=r"samples\.csv: No space left on device"):
        run.sample(sample("r2"))
    assert (run.path / "samples.csv").read_bytes().endswith(b"\n")
    monkeypatch.setattr(run._files["samples"][1], "_file", file)
    run.sample(sample("r3"))
    assert read_run(run.path).samples["request_id"].tolist() == ["r1", "r3"]


def test_the_way_out_of_the_block_is_the_state_of_the_run(tmp_path: Path, open_run: Callable[..., RunWriter]) -> None:
    def leave(error: BaseException) -> dict[str, object]:
        run = RunWriter.create(tmp_path, "latency", {"stages": STAGES})
        with pytest.raises(type(error)), run:  # noqa: PT012 - the block is what is tested
            run.sample(sample())
            raise error
        assert len(read_run(run.path).samples) == 1
        assert (run.path / "samples.parquet").exists()
        return read_run(run.path).manifest

    interrupted = leave(KeyboardInterrupt())
    assert (interrupted["state"], interrupted["error"]) == ("interrupted", "KeyboardInterrupt")
    failed = leave(StoreError("server died"))
    assert (failed["state"], failed["error"]) == ("failed", "server died")
    with open_run() as run:
        run.finish("failed", "server died")
        run.finish("finished")  # too late
    assert (read_run(run.path).manifest["state"], read_run(run.path).manifest["error"]) == ("failed", "server died")


@pytest.mark.parametrize("error", [StoreError("no server"), KeyboardInterrupt()])
@pytest.mark.parametrize("there", [".", "kept", "kept/results"])
def test_a_failure_before_the_first_row_leaves_what_was_there_before(
    tmp_path: Path, error: BaseException, there: str
) -> None:
    (tmp_path / there).mkdir(parents=True, exist_ok=True)
    before = sorted(tmp_path.rglob("*"))
    run = RunWriter.create(tmp_path / "kept" / "results", "latency", {"stages": STAGES})
    with pytest.raises(type(error)), run:  # noqa: PT012 - the block is what is tested
        (run.path / "server-http.log").write_text("no model")
        raise error
    assert sorted(tmp_path.rglob("*")) == before


def test_a_failure_that_names_a_log_keeps_the_folder_with_it(tmp_path: Path) -> None:
    run = RunWriter.create(tmp_path, "latency", {}, [])
    log = run.path / "server-http.log"
    with pytest.raises(StoreError), run:  # noqa: PT012 - the block is what is tested
        log.write_text("no memory")
        raise StoreError(f"the server died; its log is {log}")
    assert (log.read_text(), read_run(run.path).manifest["state"]) == ("no memory", "failed")


def test_a_failure_before_the_first_row_is_told_though_the_folder_has_gone(tmp_path: Path) -> None:
    run = RunWriter.create(tmp_path, "latency", {}, [])
    with pytest.raises(StoreError, match="no server"), run:  # noqa: PT012 - the block is what is tested
        rmtree(run.path)
        raise StoreError("no server")


def test_a_failure_before_the_first_row_keeps_a_folder_that_holds_runs(tmp_path: Path) -> None:
    run = RunWriter.create(tmp_path, "latency", {}, [])
    with pytest.raises(StoreError), run:  # noqa: PT012 - the block is what is tested
        (run.path / "cell").mkdir()
        raise StoreError("no room")
    assert read_run(run.path).manifest["state"] == "failed"


def test_rows_are_counted_in_files_of_either_kind_and_empty_tables_left_out(tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as run:
        run.sample(sample("r1"))
        run.sample(sample("r2", error='a "quoted"\nline'))
        assert read_run(run.path).row_counts() == {"samples": 2}
        run.tokens(token(index, "x\n") for index in range(3))
        assert read_run(run.path).row_counts() == {"samples": 2, "tokens": 3}
    (run.path / "samples.csv").write_text("not read")  # beside a whole Parquet file
    assert read_run(run.path).row_counts() == {"samples": 2, "tokens": 3}
    (run.path / "samples.parquet").write_bytes(b"PAR1")
    with pytest.raises(StoreError, match=r"samples\.parquet is damaged: .+; remove it to read the CSV$"):
        read_run(run.path).row_counts()


def test_columns_are_read_alone_and_their_texts_are_categories_in_order_of_appearance(tmp_path: Path) -> None:
    columns = ["text", "index", "engine_lo_ns", PROVENANCE]
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as run:
        run.tokens([token(0, "b"), token(1, ""), token(2, "a"), token(3, "b")])
        running = read_run(run.path).table(TOKENS, columns)
    read = read_run(run.path)
    some = read.table(TOKENS, columns)
    assert [*some] == columns
    assert (read.tables, some.attrs[PROVENANCE]) == ({}, read.origins.line)
    assert some["text"].tolist() == ["b", "", "a", "b"]
    assert some["text"].cat.categories.tolist() == ["b", "", "a"]
    assert some.dtypes[["index", "engine_lo_ns"]].tolist() == ["Int64", "Int64"]
    assert some["engine_lo_ns"].isna().all()
    whole = read.tokens
    assert whole.dtypes[["text", "index"]].tolist() == ["string", "Int64"]
    for same in (running, read.table(TOKENS, columns)):
        pd.testing.assert_frame_equal(same, some)
    samples = read_run(run.path).table(samples_table(STAGES), ["cell", "warmup", "facts"])
    assert samples.empty
    assert samples.dtypes.tolist() == ["category", "bool", "string"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "not a run folder"),
        ('{"schema": "s2a-bench/9"}', "s2a-bench/9.*s2a-bench/1"),
        (
            '{"schema": "s2a-bench/1", "command": "latency", "state": "finished", "environment": {"affinity": ["3"]}}',
            r"environment.affinity\[0\]: '3' should be a valid integer",
        ),
        *((text, "manifest.json is damaged: .") for text in ("{", "[" * 100_000, '{"a": "\\ud800"}', "\xff", "")),
        ('{"a": ' + "9" * 5000 + "}", "manifest.json is damaged: ."),
    ],
)
def test_a_folder_that_is_no_run_or_anothers_is_refused_in_one_line(
    tmp_path: Path, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / "manifest.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(StoreError, match=message) as error:
        read_run(tmp_path)
    assert len(str(error.value).splitlines()) == 1


def test_an_empty_line_is_a_row_of_one_empty_column(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("note\n\nx\n\n")
    assert read_csv(tmp_path / "t.csv", {"note": "string"}).column("note").to_pylist() == ["", "x", ""]


def test_a_damaged_csv_is_an_error_and_not_a_number(open_run: Callable[..., RunWriter]) -> None:
    run = open_run()
    run.sample(sample())
    path = run.path / "samples.csv"
    path.write_bytes(path.read_bytes().replace(b"11850", b"many"))
    with pytest.raises(StoreError, match=r"samples\.csv is damaged: .") as error:
        _ = read_run(run.path).samples
    assert len(str(error.value).splitlines()) == 1


def _words(path: Path) -> None:
    parquet.write_table(pa.table({"index": ["many"]}), path)


def _zeros(path: Path) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[:4] + bytes(200) + whole[204:])


@pytest.mark.parametrize("damage", [_words, _zeros, lambda path: path.write_bytes(b"PAR1")])
def test_a_damaged_parquet_file_is_one_line_with_the_way_out(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    with RunWriter.create(tmp_path, "latency", {"stages": STAGES}) as run:
        run.tokens([token(0, "a")])
    damage(run.path / "tokens.parquet")
    with pytest.raises(StoreError, match=r"tokens\.parquet is damaged: .+; remove it to read the CSV$") as error:
        _ = read_run(run.path).tokens
    assert len(str(error.value).splitlines()) == 1
    (run.path / "tokens.parquet").unlink()
    assert read_run(run.path).tokens["text"].tolist() == ["a"]


@pytest.mark.parametrize("torn", ["", "r1,torn", None])
def test_a_run_that_goes_on_does_so_after_its_last_whole_record(tmp_path: Path, torn: str | None) -> None:
    run = kept(tmp_path, sample("r1"))
    path = run.path / "samples.csv"
    path.write_text("" if torn is None else path.read_text() + torn)  # None: not even the header came
    ids = ["r2"] if torn is None else ["r1", "r2"]
    again = RunWriter.reopen(run.path, [samples_table(STAGES), TOKENS])
    again.sample(sample("r2"))
    read = read_run(run.path)
    assert (read.manifest["state"], read.manifest["finished"]) == ("running", None)
    assert (read.samples["request_id"].tolist(), read.row_counts()) == (ids, {"samples": len(ids)})
    again.finish("finished")
    assert read_run(run.path).samples["request_id"].tolist() == ids


def test_the_manifest_holds_only_strict_json(tmp_path: Path) -> None:
    facts = {"configuration": {"path": Path("/x"), "loss": float("nan"), "t": (1,), "on": True, "most": -math.inf}}
    with RunWriter.create(tmp_path, "latency", facts) as run:
        run.update(row=token(0, "a"), kind=TokenRow)
    manifest = read_run(run.path).manifest
    assert manifest["configuration"] == {"path": "/x", "loss": None, "t": [1], "on": True, "most": None}
    assert manifest["row"]["token_id"] == 100
    assert manifest["kind"] == str(TokenRow)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", manifest["started"])
    assert not (run.path / "manifest.json.part").exists()


WRONG = {
    "command": (5, "command: 5 should be a valid string"),
    "state": ("lost", "state: 'lost' should be 'running', 'finished', 'interrupted' or 'failed'"),
    "warnings": ([{"code": "load"}, {}], "warnings[1].code: is missing"),
    "environment": ({"gpus": ["H200"]}, "environment.gpus[0]: 'H200' should be a valid dictionary"),
    "seeds": (2**70, "seeds: 1180591620717411303424 should be a valid dictionary"),
    "argv": ({}, "argv: {} should be a valid list"),
    "configuration": ([], "configuration: [] should be a valid dictionary"),
    "servers": ({"http": 5, "ros": 6}, "servers.http: 5 should be a valid dictionary"),
    "stages": ({"capture\x1b[2J": 5}, r"stages.capture\x1b[2J: 5 should be a valid string"),
}


@pytest.mark.parametrize("key", WRONG)
def test_a_manifest_of_the_wrong_shape_is_one_line_with_file_and_key(tmp_path: Path, key: str) -> None:
    path = kept(tmp_path).path / "manifest.json"
    value, message = WRONG[key]
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(StoreError) as error:
        read_run(path.parent)
    assert str(error.value) == f"{path} is damaged: {message}"


def test_the_reference_runs_are_read() -> None:
    folders = sorted((Path(__file__).parents[2] / "results/reference").glob("*/manifest.json"))
    assert {"echo-raw", "echo-jpeg", "llama-jpeg", "timeline-live"} <= {path.parent.name for path in folders}
    assert {read_run(path.parent).manifest["state"] for path in folders} == {"finished"}


def test_a_full_disk_names_its_file_system_and_the_run_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = False
    write = manifests.write

    def no_room_but_the_reserve(folder: Path, manifest: dict[str, object]) -> None:
        if full and (folder / RESERVE).exists():
            error = OSError(28, "No space left on device")
            raise StoreError(f"cannot write {folder}: {why(error, folder)}") from error
        write(folder, manifest)

    monkeypatch.setattr("s2a_bench.store.run.manifests.write", no_room_but_the_reserve)
    run = RunWriter.create(tmp_path, "latency", {"stages": STAGES})
    assert (run.path / RESERVE).stat().st_size == RESERVE_BYTES
    with pytest.raises(StoreError, match=r"No space left on device \(file system /"), run:  # noqa: PT012
        run.sample(sample("r1"))
        full = True
        file = run._files["samples"][1]._file
        monkeypatch.setattr(run._files["samples"][1], "_file", FullDisk(file))
        run.sample(sample("r2"))
    read = read_run(run.path)
    assert read.samples["request_id"].tolist() == ["r1"]
    assert read.manifest["state"] == "failed"
    assert "No space left on device (file system /" in read.manifest["error"]
    assert not (run.path / RESERVE).exists()


def test_facts_can_be_told_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = RunWriter.create(tmp_path, "latency", {"stages": STAGES})
    monkeypatch.setattr("s2a_bench.store.manifest.os.fsync", lambda _: _refuse_while(run.path / RESERVE))
    run.update(warnings=[{"code": "x"}])
    assert read_run(run.path).manifest["warnings"] == [{"code": "x"}]
    run.finish("finished")


def _refuse_while(path: Path) -> None:
    if path.exists():
        raise OSError(28, "No space left on device")


@pytest.mark.parametrize("first", [None, RuntimeError("first")])
def test_a_run_whose_parquet_files_cannot_be_written_has_failed_of_what_went_wrong_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: Exception | None
) -> None:
    def refuse(path: Path, _table: object) -> None:
        raise StoreError(f"cannot write {path}")

    monkeypatch.setattr("s2a_bench.store.run.files.write_parquet", refuse)
    run = RunWriter.create(tmp_path, "latency", {"stages": STAGES})
    message = str(first or f"cannot write {run.path / 'samples.parquet'}")
    with pytest.raises(type(first or StoreError("")), match=re.escape(message)), run:  # noqa: PT012 - the block is tested
        run.sample(sample())
        if first:
            raise first
    assert (read_run(run.path).manifest["state"], read_run(run.path).manifest["error"]) == ("failed", message)


def test_without_pyarrow_the_run_stays_and_its_reader_is_told_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        for module in ("pyarrow", "pyarrow.csv", "pyarrow.parquet"):
            patch.setitem(sys.modules, module, None)
        run = kept(tmp_path, sample())
        assert run.manifest["state"] == "finished"
        with pytest.raises(MissingExtra, match=r"pyarrow does not load beside NumPy .*: the CSV files .* are complete"):
            _ = run.samples
    assert len(read_run(run.path).samples) == 1
