"""Smoothness in virtual time: the target and its forecast, what each mode executes of it, and what the plant makes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import gammainc

from s2a_bench.act import Motion
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, MEANS, METRICS
from s2a_bench.plugins.chunks.chunks.smooth import (
    RATE,
    TargetPath,
    TrackingPlant,
    draw_target,
    executed,
    smoothness,
)
from s2a_bench.plugins.chunks.modes import ControlSetting, Ticks, mode
from s2a_bench.plugins.chunks.modes.aggregate import WEIGHTS, Aggregate
from s2a_bench.plugins.chunks.plant import Plant
from s2a_bench.store.run import StoredRun
from tests.plugins.chunks.chunks.test_run import ran

MS = 1_000_000
SETTING = ControlSetting(20 * MS, 16)
PERIOD_S = 0.02
NAMES = [name for name in METRICS if name.startswith(("tracking", "jerk", "boundary_jump", "action_step"))]


@pytest.fixture(scope="module")
def target() -> TargetPath:
    return draw_target(np.random.default_rng(1), 400_000, PERIOD_S)


def foreseen(ticks: int) -> TargetPath:
    """A target that keeps to what is expected of it."""
    time_s = np.arange(ticks) * PERIOD_S
    decay = np.exp(-RATE * time_s)
    return TargetPath(decay * (1 + 4 * time_s), 4 * decay, PERIOD_S)


def latencies(ticks: int, count: int = 60) -> np.ndarray:
    return np.full(count, ticks * 20 * MS)


class TestTarget:
    def test_it_has_the_covariance_of_its_docstring(self, target: TargetPath) -> None:
        for lag in (0, 1, 5, 16, 40):
            time_s = lag * PERIOD_S
            found = np.mean(target.position[lag:] * target.position[: target.position.size - lag])
            assert found == pytest.approx((1 + RATE * time_s) * math.exp(-RATE * time_s), abs=0.05)

    @pytest.mark.parametrize("ahead", [0, 1, 4, 15])
    def test_the_forecast_is_the_conditional_mean(self, target: TargetPath, ahead: int) -> None:
        now = np.arange(target.position.size - ahead)
        error = target.position[now + ahead] - target.forecast(now, np.full(now.size, ahead))
        expected = float(gammainc(3, 2 * RATE * ahead * PERIOD_S)) if ahead else 0.0
        assert error.var() == pytest.approx(expected, rel=0.03, abs=1e-12)
        for known in (target.position[now], target.drift[now]):
            assert abs(np.mean(error * known)) <= 0.03 * known.std() * max(error.std(), 1e-9)

    @pytest.mark.parametrize("period_s", [1e-6, 0.02, 10.0])
    def test_at_any_control_rate_it_is_as_large(self, period_s: float) -> None:
        seeds = range(300)
        last = [draw_target(np.random.default_rng(seed), 5, period_s).position[-1] for seed in seeds]
        assert np.std(last) == pytest.approx(1, rel=0.15)

    def test_the_first_ticks_are_the_same_however_many_there_are(self, target: TargetPath) -> None:
        short = draw_target(np.random.default_rng(1), 10, PERIOD_S)
        np.testing.assert_allclose(short.position, target.position[:10])


class TestWhatIsExecuted:
    @pytest.mark.parametrize("ticks", [0, 3, 6])
    @pytest.mark.parametrize("written", ["replace", "aggregate?trigger=7&kind=average"])
    def test_where_actions_are_due_the_robot_does_what_is_foreseen(self, written: str, ticks: int) -> None:
        made, target = mode(written), foreseen(400)
        cycles, done = made.cycles(latencies(ticks), SETTING), made.ticks(latencies(ticks), SETTING)
        actions = executed(made, cycles, done, target)
        second = int(cycles.start_tick[1])  # the first chunk begins when it arrives
        np.testing.assert_allclose(actions[second + 16 :], target.position[second + 16 : actions.size], atol=1e-12)
        assert actions.size > second + 200

    @pytest.mark.parametrize(("written", "lag"), [("queue?trigger=6", 6), ("sync", 4), ("streamed?trigger=5", 5)])
    def test_where_chunks_are_appended_it_lags(self, written: str, lag: int) -> None:
        made, target = mode(written), foreseen(400)
        cycles, done = made.cycles(latencies(4), SETTING), made.ticks(latencies(4), SETTING)
        actions = executed(made, cycles, done, target)
        acted = np.flatnonzero(~np.isnan(actions))
        later = acted[acted >= cycles.start_tick[1]]
        np.testing.assert_allclose(actions[later], target.position[later - lag], atol=1e-12)
        assert np.isnan(actions).sum() == (done.chunk[: actions.size] < 0).sum()

    @pytest.mark.parametrize("kind", WEIGHTS)
    def test_blended_actions_are_those_of_a_queue_that_is_overwritten(self, kind: str, target: TargetPath) -> None:
        latency_ns = np.random.default_rng(3).integers(0, 250 * MS, 80)
        made = Aggregate(6, kind)  # type: ignore[arg-type]
        cycles, done = made.cycles(latency_ns, SETTING), made.ticks(latency_ns, SETTING)
        request_tick, usable = cycles.request_tick.tolist(), cycles.usable_tick.tolist()
        queue: dict[int, float] = {}  # by how many actions were executed before
        due: dict[int, int] = {}
        expected, executed_so_far = [], 0
        for tick in range(cycles.ticks):
            due |= {place: executed_so_far for place, at in enumerate(request_tick) if at == tick}
            for place in (place for place, at in enumerate(usable) if at == tick):
                for index in range(16):
                    new = float(target.forecast(np.array(request_tick[place]), np.array(index)))
                    at, weight = due[place] + index, WEIGHTS[made.kind]
                    queue[at] = weight * new + (1 - weight) * queue[at] if at in queue else new
            expected.append(queue.get(executed_so_far, math.nan))
            executed_so_far += executed_so_far in queue
        np.testing.assert_allclose(executed(made, cycles, done, target), expected, atol=1e-12)


def measured(written: str, latency_ns: np.ndarray, target: TargetPath) -> dict[str, float]:
    made = mode(written)
    follows = TrackingPlant(Plant(), target)
    return {**follows.measure(made, made.cycles(latency_ns, SETTING), made.ticks(latency_ns, SETTING))}


class TestNumbers:
    def test_with_replace_longer_delays_do_not_track_better(self, target: TargetPath) -> None:
        found = [measured("replace", latencies(ticks, 4000), target) for ticks in range(9)]
        error, jump = ([each[name] for each in found] for name in ("tracking_rms", "boundary_jump_mean"))
        assert (np.diff(error) > 0).all()
        assert (np.diff(jump) > 0).all()
        assert error[0] > found[0]["tracking_rms_ideal"] > 0

    def test_asked_in_every_tick_and_answered_at_once_it_is_the_ideal(self, target: TargetPath) -> None:
        found = measured("replace?execute=1", latencies(0, 4000), target)
        assert found["tracking_rms"] == found["tracking_rms_ideal"]
        assert found["jerk_rms"] == found["jerk_rms_ideal"]

    @pytest.mark.parametrize("written", ["sync", "queue?trigger=6", "replace", "aggregate?trigger=6", "streamed"])
    def test_a_target_that_rests_leaves_no_jumps_and_no_jerk(self, written: str) -> None:
        rests = TargetPath(np.zeros(3000), np.zeros(3000), PERIOD_S)
        latency_ns = np.random.default_rng(5).integers(0, 250 * MS, 200)
        assert set(measured(written, latency_ns, rests).values()) == {0}

    def test_a_run_without_an_action_has_none(self, target: TargetPath) -> None:
        never = np.full(9, -1)
        ticks = Ticks(never, never, never, np.zeros(9, np.bool_))
        assert (
            TrackingPlant(Plant(), target).measure(mode("sync"), mode("sync").cycles(latencies(9), SETTING), ticks)
            == {}
        )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    return ran(tmp_path_factory.mktemp("smooth"), cycles=400, robot="plant")


class TestRuns:
    def test_every_row_has_every_number_beside_the_ideal(self, run: StoredRun) -> None:
        table = run.table(CHUNKS)
        assert table[NAMES].notna().all().all()
        assert (table["tracking_rms"] > table["tracking_rms_ideal"]).all()
        assert (table["boundary_jump_p99"] > table["boundary_jump_mean"]).all()
        assert (table["boundary_jump_mean"] > table["action_step_mean"]).all()

    def test_at_the_sources_own_mean_a_mode_does_what_its_cell_does(self, run: StoredRun) -> None:
        table = run.table(MEANS)
        assert len(table) == 4 * 33
        assert sorted(table["latency_s"].unique()) == pytest.approx(np.linspace(0, 0.32, 33))
        cells = run.table(CHUNKS).query("rule == 'given'").set_index("mode")
        same = table[table["latency_s"] == 0.08].set_index("mode")
        for name in ("tracking_rms", "stall_share"):
            both = same[name], cells[name]
            np.testing.assert_allclose(*both, rtol=0.1, atol=0.01)  # the mean that was drawn is not quite 80 ms

    def test_without_a_robot_there_are_none(self, tmp_path: Path) -> None:
        run = ran(tmp_path, cycles=50)
        assert run.table(CHUNKS)[NAMES].isna().all().all()
        assert run.table(MEANS)["tracking_rms"].isna().all()

    def test_no_target_waits_for_actions_that_are_slowed_down(self, tmp_path: Path) -> None:
        slowed = ran(tmp_path / "slowed", slow_down=2, cycles=50, robot="plant").table(CHUNKS)
        assert slowed[NAMES].isna().all().all()
        options = {"latency": "400", "modes": "queue", "rules": "calibrated", "slowest": 4.0, "robot": "plant"}
        run = ran(tmp_path, **options, cycles=100)
        table = run.table(CHUNKS).set_index("rule")
        assert table.loc["given", NAMES].notna().all()
        assert table.loc["calibrated", NAMES].isna().all()


class TestSmoothness:
    def test_each_is_what_its_docstring_says(self) -> None:
        actions = np.array([[0.0, 0], [1, 0], [1, 0], [4, 4], [4, 4], [4, 6]])
        chunk = np.array([0, 0, -1, 1, 2, 2])
        motion = Motion(np.ones((6, 4, 2)), *np.zeros((3, 6, 4, 2)))
        motion.jerk[0, 0] = 2  # of both joints
        found = smoothness(motion, actions, chunk, np.tile([1.0, 3.0], (6, 1)))
        assert found["tracking_rms"] == pytest.approx(math.sqrt(2))
        assert found["jerk_rms"] == pytest.approx(math.sqrt(2 * 2**2 / 48))
        assert found["boundary_jump_mean"] == 2.5
        assert 4.9 < found["boundary_jump_p99"] < 5
        assert found["action_step_mean"] == pytest.approx(1.5)

    def test_one_chunk_has_no_boundary_and_nothing_is_tracked_without_a_reference(self) -> None:
        found = smoothness(Plant().respond(np.ones((3, 1)), 0.1), np.ones((3, 1)), np.zeros(3, np.int64))
        assert math.isnan(found["boundary_jump_mean"])
        assert "tracking_rms" not in found
        assert (found["jerk_rms"], found["action_step_mean"]) == (0, 0)
