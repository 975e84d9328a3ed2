"""A queue that learns as it goes does what `follow` says of the same latencies."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from s2a_bench.plugins.chunks.modes import ControlSetting, Rounding
from s2a_bench.plugins.chunks.modes.append import Queue
from s2a_bench.plugins.chunks.modes.cycles import step
from s2a_bench.plugins.chunks.modes.trigger import (
    Learning,
    LearningStepper,
    Maximum,
    Mean,
    TrackedLatency,
    TriggerRule,
    follow,
)

SETTING = ControlSetting(20_000_000, 16)


def drawn(count: int, seed: int, scale: float = 80e6) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    ticks = rng.lognormal(np.log(scale), 0.5, count) // SETTING.period_ns
    return ticks.astype(np.int64) * SETTING.period_ns + SETTING.period_ns // 2


def maximum() -> TriggerRule:
    return Maximum()


def mean() -> TriggerRule:
    return Mean()


def tracked() -> TriggerRule:
    return TrackedLatency.begin(drawn(500, 1).tolist(), 0.05)


@pytest.mark.parametrize("begin", [maximum, mean, tracked])
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
    stepper = Learning(Queue(), mean).stepper(setting)
    tick = 0
    for request, delay in enumerate(setting.delay_ticks(latency_ns).tolist()):
        while not stepper.ask(tick):
            stepper.act(tick)
            tick += 1
        stepper.arrived(request, 16, tick + delay)
    assert stepper.rule.latency_ns == pytest.approx(latency_ns.mean(), rel=0.01)


def test_each_robot_has_a_rule_of_its_own() -> None:
    mode = Learning(Queue(), maximum)
    one, other = mode.stepper(SETTING), mode.stepper(SETTING)
    assert one.ask(0)
    one.arrived(0, 16, 9)
    assert (one.rule.latency_ns, other.rule.latency_ns) == (19 * SETTING.period_ns // 2, 0)
