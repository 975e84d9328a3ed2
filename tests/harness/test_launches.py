"""Launches: every one has servers of its own, its warm-ups and its blocks, all in one run folder."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from s2a_bench.clock import VirtualClock
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.latency.run import run_latency
from s2a_bench.harness.plan import BlocksPlan, RunPlan
from s2a_bench.harness.rounds import Slot, run_blocks
from s2a_bench.harness.session import Place
from s2a_bench.inference import EngineConfig
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress

ECHO = LatencyConfig(
    engine=EngineConfig(name="echo"), transports=("http/binary", "loopback"), payload="raw", max_tokens=2, size=(64, 48)
)


def test_every_launch_has_fresh_servers_in_one_run_folder(tmp_path: Path) -> None:
    config = ECHO.but(launches=2, requests=4, warmup=1)
    run = read_run(run_latency(config, tmp_path, NullProgress()))
    samples = run.samples
    assert run.manifest["state"] == "finished"
    assert dict(samples.groupby("launch").size().items()) == {0: 10, 1: 10}
    assert samples["request_id"].is_unique
    assert samples.groupby("block").size().tolist() == [2] * 10
    assert set(samples[samples["warmup"]]["block"]) == {0, 5}
    pids = [server["pid"] for server in run.manifest["servers"].values()]
    assert run.manifest["servers"].keys() == {"http", "http-launch-2"}
    assert len(set(pids)) == 2
    assert "duplicate-frames" not in {warning["code"] for warning in run.manifest["warnings"]}
    frames = samples[samples["cell"] == "http/binary"]["frame_index"]
    assert frames.is_unique  # a source goes on where the last launch left it: no picture twice


def test_the_order_differs_from_block_to_block_and_launch_to_launch_and_the_total_is_told() -> None:
    seen: list[list[str]] = [[], []]
    progress = NullProgress()
    for launch in range(2):

        def turn(name: str, launch: int) -> None:
            seen[launch].append(name)

        slots = [lambda place, name=name: turn(name, place.launch) for name in "abcd"]
        run_blocks(slots, [], BlocksPlan(8, 0, 2, 0), progress, launch)
    assert sorted(seen[0]) == sorted(seen[1])
    assert seen[0] != seen[1]
    assert len({tuple(launch[at : at + 4]) for launch in seen for at in range(0, 32, 4)}) > 4
    assert progress.expected == progress.done == 64


def test_a_cell_thinks_from_its_own_answer_while_others_are_measured() -> None:
    clock, log = VirtualClock(), dict[str, list[tuple[int, int]]]()

    def slot(name: str, takes_ns: int) -> Slot:
        def measure(_: Place) -> None:
            started_ns = clock.now_ns()
            clock.sleep_until_ns(started_ns + takes_ns)
            log.setdefault(name, []).append((started_ns, clock.now_ns()))

        return measure

    plan = BlocksPlan(20, 0, 1, 0, think_s=1e-6)
    run_blocks([slot("quick", 100), slot("slow", 400)], [], plan, NullProgress(), clock=clock)
    for times in log.values():
        pauses_ns = [start - end for (_, end), (start, _) in pairwise(times)]
        assert min(pauses_ns) == 1000
        assert max(pauses_ns) < 2 * 1000 + 2 * 400  # at most two pauses of the other cell lie between


def test_a_pause_stands_in_configuration_and_cadence(monkeypatch: pytest.MonkeyPatch) -> None:
    plans: list[RunPlan] = []
    monkeypatch.setattr("s2a_bench.experiments.latency.run.run_requests", lambda _, plan, *__: plans.append(plan))
    for think_s in (0, 2):
        run_latency(ECHO.but(think_s=think_s), Path(), NullProgress())
    without, paused = plans
    assert (without.blocks.think_s, paused.blocks.think_s) == (0, 2)
    assert paused.manifest["configuration"]["think_s"] == 2
    said = "closed loop, the next request when the last is done"
    assert [plan.manifest["cadence"] for plan in plans] == [said, f"{said}, and 2 s after its cell's last answer"]
