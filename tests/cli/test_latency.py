"""`s2a-bench latency` as a user meets it: real servers in processes of their own, the echo engine."""

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
from tests.cli.program import called, command, printed
from tests.cli.program import only_run as only

DRAWN = ["--engine", "echo", "--quick", "--size", "64x48", "--requests", "4", "--warmup", "1", "--max-tokens", "3"]
SMALL = [*DRAWN, "--data-only"]


def run(*arguments: str, output: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    return called("latency", *arguments, "--output", output, code=code)


def only_run(output: Path) -> StoredRun:
    """Return the run, all of whose facts are declared."""
    kept = only(output)
    assert {name for facts in kept.samples["facts"] for name in json.loads(facts)} <= kept.manifest["facts"].keys()
    return kept


CELLS = {
    *("http/as-deployed", "http/best-effort", "http/binary", "ros/topic", "loopback"),
    *("http/best-effort?payload=png", "http/binary?payload=jpeg", "http/binary?host=127.0.0.2"),
    *("ros/topic?payload=yuyv", "ros/topic?qos=sensor_data"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[StoredRun, str]:
    """Measure all pipelines, and some with options of their own; return the run and what was printed."""
    output = tmp_path_factory.mktemp("whole")
    named = ",".join(["http", "ros", "loopback", *sorted(name for name in CELLS if "?" in name)])
    done = run(*DRAWN, "--transport", named, "--verbose", output=output)
    return only_run(output), done.stdout


def test_one_run_compares_pipelines_payloads_and_options_on_servers_of_their_own(whole: tuple[StoredRun, str]) -> None:
    kept, output = whole
    assert kept.manifest["state"] == "finished"
    assert set(kept.samples["cell"]) == CELLS
    assert kept.manifest["servers"].keys() == {"http", "http-2", "http-3", "ros", "ros-2"}
    logs = {f"server-{name}.log" for name in kept.manifest["servers"]}
    assert {path.name for path in kept.path.glob("server-*.log")} == logs
    assert all(name in output for name in ("as-deployed", "topic", "yuyv", "loopback", "residual", "a mark costs"))
    assert str(kept.path) in output
    for name in ("samples.csv", "samples.parquet", "tokens.parquet", "manifest.json"):
        assert (kept.path / name).stat().st_size > 0
    assert len(list((kept.path / "figures").glob("*.png"))) == 3
    assert len(list((kept.path / "figures").glob("*.pdf"))) == 3


def test_a_server_whose_latencies_are_known_answers_after_them_and_is_emulated(tmp_path: Path) -> None:
    done = run(*SMALL, "--latency", "20", "--transport", "http/binary,loopback", "--json", output=tmp_path)
    kept = only_run(tmp_path)
    assert (kept.samples["error"] == "").all()
    assert (kept.samples["inference_ns"] >= 20_000_000).all()
    assert {json.loads(facts)["latency_drawn_ms"] for facts in kept.samples["facts"]} == {20}
    assert set(kept.samples["provenance"]) == {"echo/none/emulated"}
    whole = printed(done)
    assert ("http/binary", "loopback") in {(ratio["of"], ratio["to"]) for ratio in whole["ratios"]}
    assert {(cell["emulated"], cell["profile"]) for cell in whole["cells"]} == {(True, "latencies 20 ms")}


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


def test_the_engine_saw_the_pixels_of_the_camera(whole: tuple[StoredRun, str]) -> None:
    samples = whole[0].samples
    assert samples[["rgb_source", "rgb_engine"]].notna().all().all()
    changed = samples[samples["rgb_source"] != samples["rgb_engine"]]
    assert set(changed["cell"]) == {"http/binary?payload=jpeg"}


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


def test_a_killed_server_ends_the_run_with_every_sample_kept_and_the_untuned_case_recorded(tmp_path: Path) -> None:
    process, folder = start_long(tmp_path, "--transport", "ros", "--dds-tuning", "default")
    os.kill(read_run(folder).manifest["servers"]["ros"]["pid"], signal.SIGKILL)
    _, output = process.communicate(timeout=120)
    assert process.returncode == 1
    (line,) = (line for line in output.splitlines() if line.startswith("error:"))
    assert "the ros server" in line
    assert "killed by signal 9" in line
    assert f"samples so far: {folder}" in output
    assert "Traceback" not in output
    kept = check_kept(folder, "failed")
    assert (kept.samples["error"].iloc[:-1] == "").all()  # the one that was under way is a row, too
    last = kept.samples["error"].iloc[-1]
    assert not last or last.startswith(("ServerDied", "RequestFailed"))
    assert kept.manifest["tuning"] == {"dds": "default", "malloc_keeps_large_blocks": False, "process": True}
    assert kept.manifest["servers"]["ros"]["limits"]["pixels"] == 50_000_000
    assert "FragmentSize" not in kept.manifest["servers"]["ros"]["transport"]["configuration"]


def test_an_interrupt_keeps_the_samples_and_stops_the_servers(tmp_path: Path) -> None:
    process, folder = start_long(tmp_path, "--transport", "http,ros")
    servers = [server["pid"] for server in read_run(folder).manifest["servers"].values()]
    process.send_signal(signal.SIGTERM)
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
    assert (kept.samples["error"] == "").all()
    if mode == "stream":
        assert (kept.samples["frame_age_ns"] > 0).all()
        used = kept.frames[(kept.frames["used_by"] != "") & (kept.frames["cell"] == "ros/topic")]
        assert len(used) == 5
        stages = [f"{name}_ns" for name in ("capture", "convert", "cdr_pack", "network", "cdr_parse", "channel_swap")]
        assert used[stages].notna().all(axis=None)
        assert kept.samples.loc[kept.samples["cell"] == "ros/topic", "convert_ns"].isna().all()
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
