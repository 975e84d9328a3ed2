"""Chunks are plans of equal pieces: S0, and what policies over skills do with actions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.chunks.modes import ControlSetting, Ints
from s2a_bench.plugins.chunks.modes.append import Streamed
from s2a_bench.policy import Plans, policy
from s2a_bench.policy.schedule import safe_start

PERIOD = 20_000_000
NS = 1e9


def as_plans(arrival_ns: Ints, period_ns: int, *, slowest: float = 1.0) -> Plans:
    """Take M chunks for plans: actions' arrivals after the request, shape (H, M), in ns, and Delta t.

    ``slowest`` is by how much time-scaling may stretch an action.
    """
    nominal_s = np.full((arrival_ns.shape[0], 1), period_ns / NS)
    return Plans(arrival_ns / NS, nominal_s, nominal_s, slowest * nominal_s)


def streamed_arrivals(latency_ns: Ints, gap_ns: int, horizon: int) -> Ints:
    """Return when each action arrives, shape (H, M): the first after its latency, then one every ``gap_ns``."""
    return latency_ns + gap_ns * np.arange(horizon, dtype=np.int64)[:, np.newaxis]


@given(first=st.integers(0, 10**9), gap=st.integers(0, 10**8), horizon=st.integers(1, 60), period=st.integers(1, 10**8))
def test_the_start_of_a_streamed_chunk_is_the_safe_start_of_its_plan(
    first: int, gap: int, horizon: int, period: int
) -> None:
    plans = as_plans(streamed_arrivals(np.array([first]), gap, horizon), period)
    closed = (first + (horizon - 1) * max(0, gap - period)) / 1e9
    assert safe_start(plans.arrival_s, plans.nominal_s)[0] == pytest.approx(closed, abs=1e-9)
    later = max(at - i * period for i, at in enumerate(range(first, first + gap * horizon, gap) if gap else [first]))
    assert closed * 1e9 == pytest.approx(max(later, first), abs=1)


@pytest.mark.parametrize(
    ("name", "mode"), [("naive", "naive"), ("s2a-clairvoyant", "safe")], ids=["naive", "stream-to-act"]
)
@pytest.mark.parametrize("gap_ticks", [0, 1, 2, 3])
def test_a_policy_over_skills_decides_for_actions_as_the_mode_does(name: str, mode: str, gap_ticks: int) -> None:
    setting, latency = ControlSetting(PERIOD, 8, "ceil"), np.array([3 * PERIOD])
    streamed = Streamed(gap_s=gap_ticks * PERIOD / 1e9, start=mode)  # type: ignore[arg-type]
    acted = np.flatnonzero(streamed.ticks(latency, setting).chunk == 0)
    plans = as_plans(streamed_arrivals(latency, streamed.gap_ns, 8), PERIOD)
    expected = policy(name).schedule(plans).start_s[:, 0] * 1e9 / PERIOD
    np.testing.assert_allclose(acted, expected[: acted.size], atol=1e-6)
    assert acted.size == 8


def test_waiting_for_the_whole_plan_is_an_answer_that_comes_whole() -> None:
    arrivals = streamed_arrivals(np.array([3 * PERIOD]), 2 * PERIOD, 8)
    starts = policy("wait-then-act").schedule(as_plans(arrivals, PERIOD)).start_s[:, 0] * 1e9 / PERIOD
    whole = Streamed().ticks(arrivals[-1], ControlSetting(PERIOD, 8, "ceil"))
    np.testing.assert_allclose(np.flatnonzero(whole.chunk == 0), starts, atol=1e-6)


@given(
    latency=st.integers(0, 200),
    gap=st.integers(0, 60),
    rounding=st.sampled_from(["floor", "ceil"]),
    s=st.integers(1, 9),
)
def test_a_safe_start_is_never_early_and_at_most_a_tick_late(latency: int, gap: int, rounding: str, s: int) -> None:
    setting = ControlSetting(20, 9, rounding)  # type: ignore[arg-type]
    safe, naive = (Streamed(0, s, gap * 1e-9, start) for start in ("safe", "naive"))  # type: ignore[arg-type]
    latency_ns = np.array([latency])
    ticks = safe.ticks(latency_ns, setting)
    first = int(np.argmax(ticks.chunk == 0))
    arrivals = setting.delay_ticks(latency + gap * np.arange(s))
    exact = int(np.max(arrivals - np.arange(s)))
    assert exact <= first <= exact + 1
    assert ticks.chunk[first:].tolist() == [0] * s  # no stall within the chunk
    last = int(np.flatnonzero(naive.ticks(latency_ns, setting).chunk == 0)[-1])
    assert last == exact + s - 1  # T1: naive ends when an exact start does
