"""Calibrated triggers keep their promise on latencies of any family, and follow a machine that drifts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from s2a_bench.boards.gaps import Gaps, Lognormal, Markov
from s2a_bench.boards.latency import draw_ns
from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.modes import ControlSetting, Rounding
from s2a_bench.plugins.chunks.modes.append import Queue
from s2a_bench.plugins.chunks.modes.cycles import step
from s2a_bench.plugins.chunks.modes.trigger import (
    Learning,
    LearningStepper,
    Maximum,
    Mean,
    Trigger,
    TriggerRule,
    calibrate,
    follow,
    trigger,
)
from s2a_bench.policy.conformal import EPSILON, Tracker

MS = 1_000_000
CALIBRATION = 8_000


def oracle_ticks(survival: Callable[[Any], Any], setting: ControlSetting) -> int:
    """Return the smallest safe trigger, the least m with P(d > m) <= `EPSILON`, from P(L > x) with x in s.

    It is ceil(F^-1(1 - epsilon) / Delta t) where actions leave at the start of their tick, and the floor of that where
    they leave at its end. Of a distribution without atoms.
    """
    ticks = np.arange(2**16) + (setting.rounding == "floor")
    return int(np.argmax(survival(ticks * setting.period_ns / 1e9) <= EPSILON))


def law(latencies: Lognormal | Markov) -> Callable[[Any], Any]:
    """Return P(L > x), x in s."""

    def lognormal(mean_s: float) -> Any:
        variance = math.log1p(latencies.cv**2)
        return stats.lognorm(variance**0.5, scale=mean_s * math.exp(-variance / 2))

    if isinstance(latencies, Lognormal):
        return lognormal(latencies.mean_s).sf
    normal, pause = lognormal(latencies.normal_s), lognormal(latencies.normal_s * latencies.pause_ratio)
    share = latencies.pause_share
    return lambda x: (1 - share) * normal.sf(x) + share * pause.sf(x)


def world(seed: int, family: str) -> tuple[Lognormal | Markov, ControlSetting]:
    """Draw latencies of 20 to 200 ms in the mean, at a control rate of 30 to 200 Hz."""
    rng = np.random.default_rng([seed, 1])
    mean_s = float(rng.uniform(0.02, 0.2))
    setting = ControlSetting(int(rng.choice([5, 10, 20, 33])) * MS, 4096, "floor" if rng.random() < 0.5 else "ceil")
    if family == "lognormal":
        return Lognormal(mean_s, float(rng.uniform(0.05, 0.8))), setting
    share = float(rng.uniform(0.005, 0.3))
    lasts = 1 / (1 - share) if family == "bimodal" else float(rng.uniform(5, 20))
    return Markov(mean_s, float(rng.uniform(0.05, 0.3)), share, float(rng.uniform(1.5, 6)), lasts), setting


@dataclass
class Found:
    """What a rule came to, in each setting."""

    stalls: list[float] = field(default_factory=list)
    age: list[float] = field(default_factory=list)
    """Of the first action of a chunk, over the oracle's: the part of an age that the trigger decides."""


def study(settings: int, *families: str, fresh: int = 20_000, period_ns: int = 0) -> dict[str, Found]:
    found: dict[str, Found] = {}
    for family, seed in product(families, range(settings)):
        latencies, setting = world(seed, family)
        if period_ns:
            setting = ControlSetting(period_ns, 10**6)
        known = draw_ns(latencies, np.random.default_rng([seed, 2]), CALIBRATION)
        drawn = draw_ns(latencies, np.random.default_rng([seed, 3]), fresh)
        chosen = {
            "oracle": oracle_ticks(law(latencies), setting),
            "high-confidence": ticks_of(calibrate(known).caution, setting),
            "expected": ticks_of(calibrate(known, guarantee="expected").caution, setting),
            "maximum": ticks_of(known.max(), setting),
            "mean": ticks_of(known.mean(), setting),
        }
        ages = {}
        for rule, ticks in chosen.items():
            cycles = Queue(ticks, ticks + 8).cycles(drawn, setting)
            settled = cycles.settled
            ages[rule] = float((cycles.start_tick - cycles.request_tick)[settled].mean())
            each = found.setdefault(rule, Found())
            each.stalls.append(float(np.mean(cycles.stall_ticks[settled] > 0)))
            each.age.append(ages[rule] / ages["oracle"])
    return found


def ticks_of(latency_ns: float, setting: ControlSetting) -> int:
    return trigger(float(latency_ns), setting, setting.horizon).ticks


def judge(found: dict[str, Found], fresh: int) -> None:
    for rule in ("high-confidence", "expected"):
        assert max(found[rule].stalls) <= 0.015
        assert np.median(found[rule].age) == pytest.approx(1, abs=0.1)
    assert max(found["oracle"].stalls) <= 0.01 + 4 * (0.01 / fresh) ** 0.5
    assert np.median(found["maximum"].age) > 1.3  # lerobot's rule: safe, and acts on older observations
    assert np.mean(found["maximum"].stalls) < 0.0005
    assert np.mean(np.array(found["mean"].stalls) > 0.015) > 0.9  # the mean rule: fresh, and stalls
    assert np.median(found["mean"].age) < 0.7


def test_a_calibrated_trigger_stalls_as_rarely_as_asked() -> None:
    judge(study(6, "lognormal", "bimodal"), 20_000)


@pytest.mark.slow
@pytest.mark.parametrize("period_ns", [0, MS // 10], ids=["control rates", "as good as no grid"])
def test_so_it_does_in_each_of_200_settings(period_ns: int) -> None:
    found = study(100, "lognormal", "bimodal", fresh=40_000, period_ns=period_ns)
    assert len(found["oracle"].stalls) == 200
    judge(found, 40_000)


def test_bursty_latencies_stall_as_rarely_as_asked_when_pooled() -> None:
    found = study(20, "bursty")
    assert np.mean(found["high-confidence"].stalls) <= 0.015
    assert np.mean(found["expected"].stalls) <= 0.015
    assert np.median(found["high-confidence"].age) == pytest.approx(1, abs=0.1)


def stalled(triggers: Any, latency_ns: Any, setting: ControlSetting) -> Any:
    """Tell in which cycles a queue with these triggers stalls."""
    return setting.delay_ticks(latency_ns) > triggers


@pytest.mark.parametrize("scale", [1.0, 1.3, 1.6])
@pytest.mark.parametrize("latencies", [Lognormal(0.1, 0.3), Markov(0.1, 0.15, 0.05, 3.0, 12.0)], ids=["calm", "bursty"])
def test_tracking_brings_a_machine_that_drifts_back_to_epsilon(latencies: Gaps, scale: float) -> None:
    setting = ControlSetting(20 * MS, 64)
    known = draw_ns(latencies, np.random.default_rng(1), CALIBRATION)
    fresh = np.rint(draw_ns(latencies, np.random.default_rng(2), 20_000) * scale).astype(np.int64)
    rules: dict[str, TriggerRule] = {
        "tracked": Tracker(known.tolist()),
        "maximum": Maximum(float(known.max())),
        "mean": Mean(int(known.sum()), known.size),
    }
    stalls, waits = {}, {}
    for name, rule in rules.items():
        found = follow(rule, fresh, setting, 60)
        stalls[name], waits[name] = float(np.mean(stalled(found, fresh, setting))), float(found.mean())
    assert 0.006 < stalls["tracked"] < 0.0115
    assert np.mean(stalled(ticks_of(calibrate(known).caution, setting), fresh, setting)) > 0.025 or scale == 1.0
    assert stalls["maximum"] < 0.001
    assert waits["maximum"] > 1.4 * waits["tracked"]
    assert stalls["mean"] > 0.05


def test_the_maximum_never_forgets_one_outlier_and_tracking_does() -> None:
    setting, latency_ns = ControlSetting(20 * MS, 64), np.full(2000, 50 * MS)
    latency_ns[500] = 900 * MS
    found = follow(Maximum(), latency_ns, setting, 60)
    assert set(found[501:].tolist()) == {45}
    assert np.flatnonzero(stalled(found, latency_ns, setting)).tolist() == [0, 500]
    found = follow(Tracker(latency_ns[:500].tolist(), 0.01), latency_ns[500:], setting, 60)
    assert set(found.tolist()) == {2}
    assert np.flatnonzero(stalled(found, latency_ns[500:], setting)).tolist() == [0]


@given(
    latency=st.integers(0, 400),
    most=st.integers(1, 12),
    rounding=st.sampled_from(["floor", "ceil"]),
    s=st.integers(0, 5),
)
def test_a_trigger_is_safe_at_its_latency_slowed_down_or_not(
    latency: int, most: int, rounding: Rounding, s: int
) -> None:
    latency *= 1000
    setting = ControlSetting(20_000, 13 + s, rounding)
    found = trigger(latency, setting, most)
    slowed = setting.slowed(found.beta)
    assert found.ticks <= most
    assert (found.beta == 1) == (setting.delay_ticks(np.array(latency)) <= most or latency <= most * 20_000)
    latencies = np.full(6, latency)
    assert not Queue(found.ticks, 13).cycles(latencies, slowed).stall_ticks.any()
    if found.ticks and found.beta == 1:
        assert Queue(found.ticks - 1, 13).cycles(latencies, setting).stall_ticks[1:].all()


def test_a_rule_that_needs_the_greatest_trigger_gets_it() -> None:
    assert trigger(math.inf, ControlSetting(20, 8), 5) == Trigger(5, 1.0)
    assert Tracker([1.0] * 50, 0.01).caution == math.inf  # too few to promise 1 %
    found = follow(Tracker([1.0] * 50, 0.01), np.array([90, 110, 130]), ControlSetting(20, 8), 5)
    assert found.tolist() == [5, 5, 5]


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_a_tracked_robot_stalls_while_its_latencies_exceed_the_slack(rounding: Rounding) -> None:
    setting, latencies = ControlSetting(20 * MS, 16, rounding), Lognormal(0.05, 0.2)
    known = draw_ns(latencies, np.random.default_rng(1), 2000)
    fresh = draw_ns(latencies, np.random.default_rng(2), 30_000)
    fresh[10_000:20_000] *= 2  # above the slack of 80 ms for a while
    stalls = stalled(follow(Tracker(known.tolist()), fresh, setting, 4), fresh, setting)
    assert np.mean(stalls[10_000:20_000]) > 0.1
    assert np.mean(stalls[:10_000]) < 0.0115
    assert np.mean(stalls[24_000:]) < 0.0115
    with pytest.raises(UsageError, match="calibrating on 98 promises"):
        calibrate(np.arange(98))
    with pytest.raises(ValueError, match="any speed"):
        trigger(50, ControlSetting(20, 8), 0)


SETTING = ControlSetting(20_000_000, 16)


def drawn(count: int, seed: int, scale: float = 80e6) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    ticks = rng.lognormal(np.log(scale), 0.5, count) // SETTING.period_ns
    return ticks.astype(np.int64) * SETTING.period_ns + SETTING.period_ns // 2


def tracked() -> TriggerRule:
    return Tracker(drawn(500, 1).tolist(), 0.05)


@pytest.mark.parametrize("begin", [Maximum, Mean, tracked])
@pytest.mark.parametrize("seed", range(3))
def test_the_robot_chooses_what_is_computed_of_its_latencies(begin: Callable[[], TriggerRule], seed: int) -> None:
    latency_ns = drawn(300, 100 + seed)
    mode = Learning(Queue(), begin)
    steppers: list[LearningStepper] = []

    class Watched(Learning):
        def stepper(self, setting: ControlSetting) -> LearningStepper:
            steppers.append(mode.stepper(setting))
            return steppers[-1]

    cycles, _ = step(Watched(Queue(), begin), latency_ns, SETTING)
    triggers = follow(begin(), latency_ns, SETTING, 15)
    assert steppers[0].triggers[: latency_ns.size] == triggers.tolist()
    late = cycles.settled
    stall_ticks = np.maximum(0, SETTING.delay_ticks(latency_ns) - triggers)
    np.testing.assert_array_equal(cycles.stall_ticks[late], stall_ticks[late])


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_a_mean_of_ticks_is_the_mean(rounding: Rounding) -> None:
    setting = ControlSetting(SETTING.period_ns, 16, rounding)
    latency_ns = np.random.default_rng(7).lognormal(np.log(70e6), 0.5, 4000).astype(np.int64)
    stepper = Learning(Queue(), Mean).stepper(setting)
    tick = 0
    for request, delay in enumerate(setting.delay_ticks(latency_ns).tolist()):
        while not stepper.ask(tick):
            stepper.act(tick)
            tick += 1
        stepper.arrived(request, 16, tick + delay)
    assert stepper.rule.caution == pytest.approx(latency_ns.mean(), rel=0.01)


def test_each_robot_has_a_rule_of_its_own() -> None:
    mode = Learning(Queue(), Maximum)
    one, other = mode.stepper(SETTING), mode.stepper(SETTING)
    assert one.ask(0)
    one.arrived(0, 16, 9)
    assert (one.rule.caution, other.rule.caution) == (19 * SETTING.period_ns // 2, 0)
