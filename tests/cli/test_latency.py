"""`s2a-bench latency` as a user runs it: real servers in processes of their own, the echo engine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections import Counter
from pathlib import Path
from threading import Event

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.harness.session import INTERRUPTED
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.trace import budget
from tests.cli.program import command, printed, program
from tests.cli.program import only_run as only

DRAWN = ["--engine", "echo", "--quick", "--size", "64x48", "--requests", "4", "--warmup", "1", "--max-tokens", "3"]
SMALL = [*DRAWN, "--data-only"]


def run(*arguments: str, output: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return program("latency", *arguments, "--output", output, code=code)


def only_run(output: Path) -> StoredRun:
    """Return the run, all of whose facts are declared."""
    kept = only(output)
    assert {name for facts in kept.samples["facts"] for name in json.loads(facts)} <= kept.manifest["facts"].keys()
    return kept


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[StoredRun, str]:
    """Measure all pipelines; return the run and what was printed."""
    output = tmp_path_factory.mktemp("whole")
    done = run(*DRAWN, "--transport", "http,ros,loopback", "--requests", "8", "--verbose", output=output)
    return only_run(output), done.stdout


def test_one_run_compares_all_pipelines(whole: tuple[StoredRun, str]) -> None:
    kept, output = whole
    names = {"http/as-deployed", "http/best-effort", "http/binary", "ros/topic", "loopback"}
    assert kept.manifest["state"] == "finished"
    assert set(kept.samples["cell"]) == names
    assert all(name in output for name in ("as-deployed", "topic", "loopback", "residual", "a mark costs"))
    assert str(kept.path) in output
    for name in ("samples.csv", "samples.parquet", "tokens.parquet", "manifest.json"):
        assert (kept.path / name).stat().st_size > 0
    assert len(list((kept.path / "figures").glob("*.png"))) == 3
    assert len(list((kept.path / "figures").glob("*.pdf"))) == 3


def test_a_server_whose_latencies_are_known_answers_after_them_and_is_emulated_in_every_place(tmp_path: Path) -> None:
    done = run(*DRAWN, "--latency", "20", "--transport", "http/binary,ros,loopback", "--json", output=tmp_path)
    kept = only_run(tmp_path)
    assert (kept.samples["error"] == "").all()
    assert (kept.samples["inference_ns"] >= 20_000_000).all()
    assert {json.loads(facts)["latency_drawn_ms"] for facts in kept.samples["facts"]} == {20}
    assert set(kept.samples["provenance"]) == {"echo/none/emulated"}
    whole = printed(done)
    compared = {(ratio["of"], ratio["to"]) for ratio in whole["ratios"]}
    assert {("http/binary", "ros/topic"), ("ros/topic", "loopback")} <= compared
    cells = whole["cells"]
    assert {(cell["emulated"], cell["profile"]) for cell in cells} == {(True, "latencies 20 ms")}
    for path in (kept.path / "tables").glob("*.md"):
        assert "Echo engine, EMULATED: latencies 20 ms" in path.read_text(), path


def test_every_sample_closes_its_budget(whole: tuple[StoredRun, str]) -> None:
    samples = whole[0].samples
    assert (samples["error"] == "").all()
    for row in samples.itertuples():
        spent = budget([tuple(mark) for mark in json.loads(str(row.marks))])
        assert sum(spent.stages_ns.values()) + spent.residual_ns == spent.e2e_ns == row.e2e_ns


def test_every_token_has_its_two_times(whole: tuple[StoredRun, str]) -> None:
    kept, _ = whole
    assert Counter(kept.tokens.groupby(["request_id"]).size()) == {3: len(kept.samples)}
    assert (kept.tokens["client_ns"] > kept.tokens["engine_ns"]).all()


@pytest.mark.slow
def test_stream_mode_knows_the_age_of_the_frame(tmp_path: Path) -> None:
    done = run(*SMALL, "--transport", "http,ros", "--mode", "stream", "--fps", "60", "--verbose", output=tmp_path)
    assert "Frame path" in done.stdout
    kept = only_run(tmp_path)
    assert (kept.samples["error"] == "").all()
    assert (kept.samples["frame_age_ns"] > 0).all()
    used = kept.frames[(kept.frames["used_by"] != "") & (kept.frames["cell"] == "ros/topic")]
    assert len(used) == 5
    stages = [f"{name}_ns" for name in ("capture", "convert", "cdr_pack", "network", "cdr_parse", "channel_swap")]
    assert used[stages].notna().all(axis=None)
    ros = kept.samples[kept.samples["cell"] == "ros/topic"]
    assert ros["convert_ns"].isna().all()


def test_one_run_compares_payloads_and_options_on_servers_of_their_own(tmp_path: Path) -> None:
    cells = ["http/binary", "http/binary?payload=png", "http/binary?host=127.0.0.2", "ros/topic?payload=yuyv"]
    cells += ["ros/topic?qos=sensor_data", "loopback"]
    done = run(*SMALL, "--transport", ",".join(cells), output=tmp_path)
    kept = only_run(tmp_path)
    assert set(kept.samples["cell"]) == set(cells)
    assert (kept.samples["error"] == "").all()
    assert kept.manifest["servers"].keys() == {"http", "http-2", "ros", "ros-2"}
    assert {path.name for path in kept.path.glob("server-*.log")} == {
        *("server-http.log", "server-http-2.log", "server-ros.log", "server-ros-2.log"),
    }
    assert "yuyv" in done.stdout


def test_the_engine_saw_the_pixels_of_the_camera(tmp_path: Path) -> None:
    names = "http/binary,http/best-effort?payload=png,http/binary?payload=jpeg,ros,ros/topic?payload=yuyv,loopback"
    run(*SMALL, "--transport", names, output=tmp_path)
    samples = only_run(tmp_path).samples
    assert samples[["rgb_source", "rgb_engine"]].notna().all().all()
    changed = samples[samples["rgb_source"] != samples["rgb_engine"]]
    assert set(changed["cell"]) == {"http/binary?payload=jpeg"}


def test_the_untuned_case_is_recorded_as_such(tmp_path: Path) -> None:
    run(*SMALL, "--transport", "ros", "--dds-tuning", "default", output=tmp_path)
    manifest = only_run(tmp_path).manifest
    assert manifest["tuning"] == {"dds": "default", "malloc_keeps_large_blocks": False, "process": True}
    assert manifest["servers"]["ros"]["limits"]["pixels"] == 50_000_000
    assert "FragmentSize" not in manifest["servers"]["ros"]["transport"]["configuration"]


def test_the_manifest_tells_the_machine(whole: tuple[StoredRun, str]) -> None:
    manifest = whole[0].manifest
    assert manifest["tuning"]["dds"] == "tuned"
    assert "65000B" in manifest["servers"]["ros"]["transport"]["configuration"]
    assert {"cpu", "kernel", "python", "packages", "load", "rmem_max", "affinity"} <= set(manifest["environment"])
    assert manifest["mark_cost_ns"] > 0
    assert manifest["seeds"]["order"] == 0
    assert manifest["argv"][1:3] == ["latency", "--engine"]


def start_long(output: Path, *arguments: str) -> tuple[subprocess.Popen[str], Path]:
    """Start a run that would take very long and wait until it has some samples."""
    process = subprocess.Popen(
        command("latency", *SMALL, "--requests", "1000000", *arguments, "--output", output),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = now_ns() + 120_000_000_000
    while now_ns() < deadline and process.poll() is None:
        for file in output.glob("*/samples.csv"):
            if file.read_text().count("\n") > 30:
                return process, file.parent
        Event().wait(0.02)
    process.kill()
    raise AssertionError(process.communicate()[1])


def check_kept(folder: Path, state: str) -> StoredRun:
    kept = read_run(folder)
    assert kept.manifest["state"] == state
    assert len(kept.samples) >= 29
    assert (folder / "samples.parquet").exists()
    return kept


@pytest.mark.parametrize("transport", ["http", "ros"])
def test_a_killed_server_ends_the_run_with_every_sample_kept(tmp_path: Path, transport: str) -> None:
    process, folder = start_long(tmp_path, "--transport", transport)
    os.kill(read_run(folder).manifest["servers"][transport]["pid"], signal.SIGKILL)
    _, output = process.communicate(timeout=120)
    assert process.returncode == 1
    (line,) = (line for line in output.splitlines() if line.startswith("error:"))
    assert f"the {transport} server" in line
    assert "killed by signal 9" in line
    assert f"samples so far: {folder}" in output
    assert "Traceback" not in output
    errors = check_kept(folder, "failed").samples["error"]
    assert (errors.iloc[:-1] == "").all()  # the one that was under way is a row, too
    last = errors.iloc[-1]
    assert not last or last.startswith(("ServerDied", "RequestFailed"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_keeps_the_samples_and_stops_the_servers(tmp_path: Path, number: signal.Signals) -> None:
    process, folder = start_long(tmp_path, "--transport", "http,ros")
    servers = [server["pid"] for server in read_run(folder).manifest["servers"].values()]
    process.send_signal(number)
    _, output = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted" in output
    assert "Traceback" not in output
    check_kept(folder, "interrupted")
    for pid in servers:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.slow
def test_a_run_beside_another_has_a_namespace_of_its_own_unless_it_is_told_that_of_the_other(tmp_path: Path) -> None:
    process, first = start_long(tmp_path / "first", "--transport", "ros/topic,ros/action,http/as-deployed")
    try:
        run(*SMALL, "--transport", "ros/topic,ros/action,http/as-deployed", output=tmp_path / "second")
        taken = read_run(first).manifest["servers"]["ros"]["address"]
        output = run(*SMALL, "--transport", "ros", "--namespace", taken, output=tmp_path / "third", code=1).stderr
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    second = only_run(tmp_path / "second")
    assert (second.samples["error"] == "").all()
    assert second.manifest["servers"]["ros"]["address"] != taken
    assert (check_kept(first, "interrupted").samples["error"].isin({"", INTERRUPTED})).all()
    last = output.strip().splitlines()[-1]
    assert last.startswith(f"error: another server answers under {taken} in DDS domain")
    assert "ROS_DOMAIN_ID or another --namespace" in last


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["request", "stream"])
def test_a_run_is_recorded_and_its_frames_are_a_source(tmp_path: Path, mode: str) -> None:
    from rosbags.highlevel import AnyReader

    bag = tmp_path / "run.mcap"
    few = ["--transport", "http/binary,ros", "--mode", mode, "--record", str(bag)]
    run(*SMALL, *few, output=tmp_path / "results")
    kept = only_run(tmp_path / "results")
    with AnyReader([bag]) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        tokens = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/s2a_bench/ros/topic/token"
        ]
    assert counts["/s2a_bench/http/binary/request"] == counts["/s2a_bench/ros/topic/request"] == 5
    assert counts["/s2a_bench/http/binary/token"] == 15
    assert counts["/s2a_bench/camera/image_raw"] >= 10
    seen = kept.tokens[kept.tokens["cell"] == "ros/topic"]
    assert [token.text for token in tokens] == list(seen["text"])
    run(*SMALL, "--source", f"bag:{bag}", "--transport", "http", output=tmp_path / "again")
    assert (only_run(tmp_path / "again").samples["error"] == "").all()
