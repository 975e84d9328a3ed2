"""`ccrb --closed-loop`: the same outcomes as roll-outs, on a virtual clock and on the real one."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from threading import enumerate as threads
from typing import Any

import numpy as np
import pandas as pd
import pytest

from s2a_bench.act.events import AbortRequested, Event, Requested, StreamEnded, VirtualInbox
from s2a_bench.clock import SystemClock, VirtualClock
from s2a_bench.errors import TransportError
from s2a_bench.experiments.ccrb.config import CcrbClosedLoop, CcrbLiveLoop, DrivingRequests
from s2a_bench.experiments.ccrb.drives import Prepared, TableRows, loop_rows, motion_of
from s2a_bench.experiments.ccrb.live import run_live_loop
from s2a_bench.experiments.ccrb.loop import ClosedLoop, CommandedEgo, replayed
from s2a_bench.experiments.ccrb.rows import ROLLOUTS
from s2a_bench.experiments.ccrb.run import resolve
from s2a_bench.frames import FrameSource
from s2a_bench.inference import EngineConfig
from s2a_bench.plan.skillset import GAPS, Gap
from s2a_bench.policy import COMPARED
from s2a_bench.scenario import EGO, LEAD, DriveCommand, State
from s2a_bench.scenario.ccrb.drive import Driven, drive
from s2a_bench.scenario.ccrb.ego import ACTING, DONE, GAP
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import draw
from s2a_bench.scenario.embedded import Embedded
from s2a_bench.scenario.longitudinal import Longitudinal
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.transport.loopback.in_process import LoopbackClient
from s2a_bench.types import Frame, Piece, Request


def scenario(number: int) -> CcrbClosedLoop:
    """Return one of 20 random scenarios."""
    at: dict[str, Any] = {
        name: values[number].item() for name, values in draw(np.random.default_rng(45), 20).numbers.items()
    }
    same = ("front_gap_m", "lead_decel_mps2", "rear_gap_m", "reaction_s", "n_skills", "t_nom_s")
    numbers = {name: at[name] for name in same}
    options = CcrbOptions(**numbers, speed_kmh=at["speed_mps"] * 3.6, gap=GAPS[number % len(GAPS)])
    return CcrbClosedLoop(
        rate=at["tokens_per_s"], prompt_s=at["prompt_s"], tokens_per_skill=at["tokens_per_skill"], scenario=options
    )


def driven(ready: Prepared, name: str) -> Driven:
    return drive(Longitudinal(), ready.scenario.cars, ready.scenario.driving, ready.schedules[name])


def check_alike(looped: Driven, expected: Driven, within_m: float) -> None:
    assert looped.outcomes.name(0) == expected.outcomes.name(0)
    for name in ("min_front_gap_m", "min_rear_gap_m"):
        assert getattr(looped.outcomes, name) == pytest.approx(getattr(expected.outcomes, name), abs=within_m)


@pytest.mark.parametrize("number", range(6))
def test_on_the_same_arrivals_a_loop_ends_as_its_roll_out(number: int) -> None:
    config = scenario(number)
    ready, name = resolve(config).ready, COMPARED[number % 3]
    looped = replayed(config.scenario, Embedded(), ready.policies[name], ready.plans)
    check_alike(looped.driven, driven(ready, name), 0.03)
    assert (looped.record.outcome, looped.real_time_factor) == ("completed", 1.0)


def test_a_board_of_which_the_first_token_takes_minutes_hits_the_lead_as_in_its_roll_out() -> None:
    config = CcrbClosedLoop(prompt_s=200.0)
    ready = resolve(config).ready
    looped = replayed(config.scenario, Longitudinal(), ready.policies["naive"], ready.plans)
    assert (looped.record.outcome, len(looped.record.ran)) == ("completed", 5)
    assert looped.driven.outcomes.name(0) == driven(ready, "naive").outcomes.name(0) == "front"


def test_motion_does_not_depend_on_when_the_first_sample_was() -> None:
    config = CcrbClosedLoop()
    schedule = resolve(config).ready.schedules["naive"]
    path = drive(Longitudinal(), config.scenario.cars, config.scenario.driving, schedule, record=True).trajectory
    assert path is not None
    assert motion_of(replace(path, time_s=path.time_s + 0.013)) == pytest.approx(motion_of(path))


@pytest.mark.parametrize("number", range(2))
def test_a_step_as_on_the_clock_changes_gaps_by_decimetres_at_most(number: int) -> None:
    config, world = scenario(number), Longitudinal()
    ready, world.step_s = resolve(config).ready, 0.02
    for name in COMPARED:
        looped = replayed(config.scenario, world, ready.policies[name], ready.plans)
        check_alike(looped.driven, driven(ready, name), 0.2)


def run(folder: Path, profile: str = "jetson-agx-orin", **options: Any) -> StoredRun:
    requests = DrivingRequests(transports="loopback", engine=EngineConfig(name="replay", profile=profile))
    return read_run(run_live_loop(CcrbLiveLoop(requests=requests, **options), folder, NullProgress()))


def by_study(stored: StoredRun, study: str) -> pd.DataFrame:
    rows = stored.table(ROLLOUTS)
    return rows[rows["study"] == study].set_index("policy")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("front_gap_m", "rear_gap_m", "gap"), [(40.0, 14.0, "stop"), (12.0, 20.0, "coast"), (60.0, 10.0, "hold")]
)
def test_in_real_time_a_loop_ends_as_the_roll_out_of_the_arrivals_that_it_had(
    front_gap_m: float, rear_gap_m: float, gap: Gap, tmp_path: Path
) -> None:
    options = CcrbOptions(front_gap_m=front_gap_m, rear_gap_m=rear_gap_m, gap=gap)
    stored = run(tmp_path, scenario=options, simulator="embedded", policies=("naive", "wait-then-act"))
    loops, rollouts = by_study(stored, "point"), by_study(stored, "rollout")
    assert list(loops["outcome"]) == list(rollouts["outcome"])
    assert loops["min_front_gap_m"].to_numpy() == pytest.approx(rollouts["min_front_gap_m"].to_numpy(), abs=1.0)
    assert loops["min_rear_gap_m"].to_numpy() == pytest.approx(rollouts["min_rear_gap_m"].to_numpy(), abs=1.0)
    assert loops["start_ns"].to_numpy() == pytest.approx(rollouts["start_ns"].to_numpy(), abs=200e6)


class Heavy(Longitudinal):
    """A world whose steps take time."""

    def __init__(self, clock: VirtualClock, costs_s: Iterator[float]) -> None:
        super().__init__()
        self._clock, self._costs_s = clock, costs_s

    def step(self, command: DriveCommand) -> State:
        self._clock.sleep_until_ns(self._clock.now_ns() + round(next(self._costs_s, 0.0) * 1e9))
        return super().step(command)


@pytest.mark.parametrize(("each_s", "once_s", "factor"), [(0.01, 0.0, 0.5), (0.0, 0.09, 1.0), (0.0, 0.6, 0.9)])
def test_a_world_that_is_slow_is_told_as_a_factor_and_one_late_step_is_caught_up(
    each_s: float, once_s: float, factor: float
) -> None:
    clock = VirtualClock()
    loop = ClosedLoop(
        CcrbOptions(), Heavy(clock, iter([once_s, *[each_s] * 3000])), VirtualInbox(clock, [Requested(0)]), clock
    )
    loop.wait(0)
    loop.wait(5_000_000_000)
    assert loop.real_time_factor == pytest.approx(factor, abs=0.02)


def test_before_the_request_all_cars_keep_their_speed() -> None:
    clock, world = VirtualClock(), Longitudinal()
    loop = ClosedLoop(CcrbOptions(), world, VirtualInbox(clock, [Requested(3_000_000_000)]), clock)
    loop.wait(3_000_000_000)
    before = world.step(DriveCommand(np.zeros((3, 1)), np.zeros(1, int)))
    assert np.ptp(before.speed_mps) == 0
    assert before.position_m[LEAD, 0] - before.position_m[EGO, 0] == pytest.approx(40.0)
    loop.wait(4_000_000_000)
    after = world.step(DriveCommand(np.zeros((3, 1)), np.zeros(1, int)))
    assert after.speed_mps[LEAD, 0] < before.speed_mps[LEAD, 0] - 1.0


class Still(FrameSource):
    """A camera whose one picture is repeated with its stamp."""

    def read(self) -> Frame:
        return Frame(0, 0, 2, 2, "bgr8", np.zeros((2, 2, 3), np.uint8))

    def close(self) -> None: ...


def test_a_view_that_does_not_change_is_kept_five_times_a_second_as_any_other() -> None:
    clock = VirtualClock()
    loop = ClosedLoop(CcrbOptions(), Longitudinal(), VirtualInbox(clock), clock, Still())
    loop.wait(2_000_000_000)
    assert len(loop.pictures) == 10


def ego_at(scene: CcrbOptions) -> tuple[CommandedEgo, VirtualClock]:
    clock = VirtualClock()
    return CommandedEgo(scene, lambda: clock.now_ns() / 1e9, lambda at_ns: at_ns / 1e9), clock


def test_an_extended_skill_keeps_the_speed_that_it_has_reached() -> None:
    scene = CcrbOptions(n_skills=2, t_nom_s=1.0, speed_kmh=36.0)
    ego, clock = ego_at(scene)
    lag, still, far = [], np.full(1, 7.0), np.full(1, 1e6)

    def look(at_s: float) -> None:
        clock.sleep_until_ns(round(at_s * 1e9))
        ego.decide(at_s, still, far, far, far, 0.005)
        lag.append((int(ego.phase[0]), round(float(ego.lag_mps[0]), 3)))

    skill = ego.start(scene.calls[0], 1_000_000_000, print)
    look(0.5)
    clock.sleep_until_ns(1_000_000_000)
    skill.retime(1_500_000_000)
    look(1.2)
    clock.sleep_until_ns(1_300_000_000)
    skill.retime(1_300_000_000)
    look(1.3)
    ego.start(scene.calls[1], 2_300_000_000, print)
    look(1.8)
    look(2.4)
    # The set-point falls from 10 to 5 and to 0 m/s; the car goes at 7.
    assert lag[:2] == [(ACTING, 0.5), (ACTING, -2.0)]
    assert lag[2][0] == GAP
    assert lag[3] == (ACTING, -4.5)
    assert lag[4][0] == DONE


def test_a_world_that_is_lost_ends_the_run_and_keeps_what_was_driven(
    fast_board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lose(*given: Any) -> Iterator[TableRows]:
        yield from loop_rows(*given)

        def lost(*_: object) -> State:
            raise TransportError("`simulator`: the server is gone")

        monkeypatch.setattr(Longitudinal, "step", lost)

    monkeypatch.setattr("s2a_bench.experiments.ccrb.live.loop_rows", lose)
    options = CcrbOptions(n_skills=3, speed_kmh=20, t_nom_s=0.4)
    with pytest.raises(TransportError, match="`simulator`: the server is gone"):
        run(tmp_path, scenario=options, profile=fast_board, policies=("naive", "wait-then-act"))
    (folder,) = tmp_path.glob("*-ccrb-*")
    assert list(by_study(read_run(folder), "point").index) == ["naive"]
    assert not [each for each in threads() if each.name.startswith("world")]


def ends_interrupted(folder: Path, profile: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(folder, scenario=CcrbOptions(n_skills=3, speed_kmh=20, t_nom_s=0.4), profile=profile)
    assert not [each for each in threads() if each.name.startswith("world")]


def test_ctrl_c_ends_the_world_with_the_request(
    fast_board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, asked = LoopbackClient.request, [0]

    def interrupted(self: LoopbackClient, request: Request, trace: Any) -> Iterator[Piece]:
        asked[0] += 1
        for token in whole(self, request, trace):
            if asked[0] == 2:
                raise KeyboardInterrupt
            yield token

    monkeypatch.setattr(LoopbackClient, "request", interrupted)
    ends_interrupted(tmp_path, fast_board)


def test_ctrl_c_before_the_request_is_an_interruption_too(
    fast_board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sleep = SystemClock.sleep_until_ns

    def interrupted(self: SystemClock, deadline_ns: int) -> None:
        if any(each.name.startswith("world") for each in threads()):
            raise KeyboardInterrupt
        sleep(self, deadline_ns)

    monkeypatch.setattr(SystemClock, "sleep_until_ns", interrupted)
    ends_interrupted(tmp_path, fast_board)


def test_ctrl_c_while_a_whole_plan_is_driven_does_not_wait_for_its_end(
    fast_board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, seen, wait = ClosedLoop.put, list[Event](), Future.result

    def noted(self: ClosedLoop, event: Event) -> None:
        put(self, event)
        seen.append(event)

    def interrupted(self: Future[Any], timeout: float | None = None) -> Any:
        if isinstance(seen[-1], StreamEnded):
            raise KeyboardInterrupt
        return wait(self, timeout)

    monkeypatch.setattr(ClosedLoop, "put", noted)
    monkeypatch.setattr(Future, "result", interrupted)
    ends_interrupted(tmp_path, fast_board)
    assert isinstance(seen[-1], AbortRequested)
