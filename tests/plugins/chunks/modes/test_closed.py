"""Every closed form against the modes in virtual time: exact where nothing is random, and where it stops to hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import stats

from s2a_bench.plugins.chunks.modes import ControlSetting, Mode, Rounding, mode
from s2a_bench.plugins.chunks.modes.aggregate import Aggregate
from s2a_bench.plugins.chunks.modes.append import Queue, Streamed, Sync
from s2a_bench.plugins.chunks.modes.closed import Closed, appended, replace_stall_share, slow_down, stall_share
from s2a_bench.plugins.chunks.modes.replace import Replace
from s2a_bench.policy.schedule import safe_start
from tests.conftest import examples

PERIOD = 20
ROUNDINGS = st.sampled_from(["floor", "ceil"])
steady = settings(max_examples=examples(150))


def constant(latency: int, requests: int = 8) -> Any:
    return np.full(requests, latency, np.int64)


# (a) queue and sync, (b) replace, (c) reaction


@st.composite
def cases_at_a_constant_latency(draw: st.DrawFn) -> tuple[Mode, int, ControlSetting]:
    horizon = draw(st.integers(1, 14))
    execute, trigger = draw(st.integers(1, horizon)), draw(st.integers(0, 12))
    streamed = Streamed(trigger, execute, draw(st.integers(0, 50)) * 1e-9)
    replaces = (Replace(execute), Replace(execute, "many"))
    made = draw(st.sampled_from([Sync(execute), Queue(trigger, execute), streamed, *replaces, Aggregate(trigger)]))
    return made, draw(st.integers(0, 400)), ControlSetting(PERIOD, horizon, draw(ROUNDINGS))


@steady
@given(case=cases_at_a_constant_latency())
def test_in_the_steady_state_each_cycle_is_that_of_the_closed_form(case: tuple[Mode, int, ControlSetting]) -> None:
    """What a stall takes, an action's age and a reaction follow: the wait w and the cycle c of the next request."""
    made, latency, setting = case
    form, cycles = made.closed_form(constant(latency), setting), made.cycles(constant(latency, 60), setting)
    settled, lasts = slice(40, 50), np.diff(cycles.request_tick)[40:50].tolist()
    if form.p_stall is not None:
        stalls = cycles.executed[settled] < lasts  # no boundary where a chunk is all past when it arrives
        assert stalls.tolist() == [form.p_stall == 1] * 10
    if form.wait_ticks is not None and form.cycle_ticks is not None:
        wait, cycle = form.wait_ticks[0], form.cycle_ticks[0]
        assert (cycles.start_tick - cycles.request_tick)[settled].tolist() == [wait] * 10
        assert lasts == [cycle] * 10
        assert form.mean_reaction_ticks == wait + cycle / 2


@steady
@given(
    latency=st.integers(0, 300),
    trigger=st.integers(0, 12),
    s=st.integers(1, 9),
    gap=st.integers(0, 50),
    rounding=ROUNDINGS,
)
def test_a_queue_stalls_for_what_the_delay_exceeds_the_trigger_by_and_answers_take_longer_than_they_last(
    latency: int, trigger: int, s: int, gap: int, rounding: Rounding
) -> None:
    setting = ControlSetting(PERIOD, 9, rounding)
    made = Streamed(trigger, s, gap * 1e-9)
    ready = int(setting.delay_ticks(np.array(latency))) + made.hold_ticks(setting)
    known = int(setting.known_ticks(np.array(latency + (s - 1) * gap)))
    cycles = made.cycles(constant(latency, 60), setting)
    assert cycles.stall_ticks[40] == max(0, ready - trigger, known - s)  # against known - s no trigger helps
    assert cycles.executed[40] == s  # nothing is skipped


@steady
@given(
    latency=st.integers(0, 300),
    s=st.integers(1, 9),
    rest=st.integers(0, 6),
    rounding=ROUNDINGS,
    under_way=st.sampled_from(["one", "many"]),
)
def test_replace_stalls_for_what_a_cycle_and_a_delay_exceed_the_chunk_by(
    latency: int, s: int, rest: int, rounding: Rounding, under_way: Any
) -> None:
    setting = ControlSetting(PERIOD, s + rest, rounding)
    cycles = Replace(s, under_way).cycles(constant(latency, 60), setting)
    delay, known = (int(each(np.array(latency))) for each in (setting.delay_ticks, setting.known_ticks))
    cycle = max(s, known) if under_way == "one" else s
    stall = min(cycle, max(0, cycle + delay - setting.horizon))
    assert cycles.executed[25:35].tolist() == [cycle - stall] * 10
    if delay < setting.horizon:
        assert cycles.stall_ticks[25:35].tolist() == [stall] * 10
        assert cycles.first_index[25:35].tolist() == [delay] * 10  # ages from d on


# (d) streamed


@given(first=st.integers(0, 10**9), gap=st.integers(0, 10**8), horizon=st.integers(1, 60), period=st.integers(1, 10**8))
def test_the_start_of_a_streamed_chunk_is_the_safe_start_of_its_plan(
    first: int, gap: int, horizon: int, period: int
) -> None:
    arrival_ns = first + gap * np.arange(horizon)[:, np.newaxis]
    start_s = safe_start(arrival_ns / 1e9, np.full((horizon, 1), period / 1e9))
    assert start_s[0] == pytest.approx((first + (horizon - 1) * max(0, gap - period)) / 1e9, abs=1e-9)


@given(latency=st.integers(0, 200), gap=st.integers(0, 60), rounding=ROUNDINGS, s=st.integers(1, 9))
def test_a_safe_start_is_never_early_and_at_most_a_tick_late(
    latency: int, gap: int, rounding: Rounding, s: int
) -> None:
    setting = ControlSetting(20, 9, rounding)
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


# (e) random latencies


def lognormal(rng: np.random.Generator, mean: float, cv: float, count: int) -> Any:
    variance = np.log1p(cv**2)
    return rng.lognormal(np.log(mean) - variance / 2, variance**0.5, count).astype(np.int64)


def within(stalls: int, count: int, probability: float) -> bool:
    return bool(stats.binomtest(stalls, count, probability).pvalue > 0.001)


MS = 1_000_000
RANDOM = [(Queue(4, 8), 4), (Queue(5, 16), 5), (Aggregate(3), 3), (Aggregate(7), 7), (Replace(12, "one"), 4)]


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
@pytest.mark.parametrize(("made", "slack"), RANDOM)
def test_a_cycle_stalls_as_often_as_its_latency_exceeds_the_slack(made: Mode, slack: int, rounding: Rounding) -> None:
    setting, count = ControlSetting(20 * MS, 16, rounding), 200_000
    latency = np.minimum(lognormal(np.random.default_rng(5), 60 * MS, 0.35, count), 12 * 20 * MS)  # no overlap
    cycles = made.cycles(latency, setting)
    stalls = int(np.count_nonzero(cycles.stall_ticks[1:]))
    assert stalls == int((setting.delay_ticks(latency[1:]) > slack).sum())  # the very cycles
    variance = np.log1p(0.35**2)
    law = stats.lognorm(variance**0.5, scale=60 * MS * np.exp(-variance / 2))
    at = slack * 20 * MS if rounding == "ceil" else (slack + 1) * 20 * MS
    assert within(stalls, count - 1, float(law.sf(at)))


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_where_latencies_exceed_s_one_late_answer_makes_the_next_one_late_too(rounding: Rounding) -> None:
    setting, s, count = ControlSetting(20 * MS, 8, rounding), 3, 20_000
    latency = lognormal(np.random.default_rng(7), 60 * MS, 0.5, count)
    cycles = Replace(s).cycles(latency, setting)
    # A chunk that is all past when it arrives has no boundary; the tick before a cycle's end says what it left.
    gap = cycles.usable_tick[1:] - cycles.request_tick[:-1] - 8
    share = float(np.mean(gap[1:] > 0))
    delay, known = setting.delay_ticks(latency), setting.known_ticks(latency)
    expected = replace_stall_share(delay, known, s, 8)
    assert share == pytest.approx(expected, abs=4 * (expected / count * 2) ** 0.5)
    assert share > 2 * stall_share(delay, 8 - s)  # P(L > (H - s) Delta t) alone
    assert Replace(s).ticks(latency[:2000], setting).stalled.any()
    assert cycles.settled.sum() > 0.9 * count


def test_the_share_over_pairs_is_the_share_over_all_pairs() -> None:
    rng = np.random.default_rng(8)
    delay = rng.integers(0, 9, 60)
    known = delay + rng.integers(0, 2, 60)
    pairs = [max(3, before) + after > 8 for before in known for after in delay]
    assert replace_stall_share(delay, known, 3, 8) == pytest.approx(np.mean(pairs))


# (f) where nothing but slowing down helps


@steady
@given(
    latency=st.integers(1, 900),
    s=st.integers(1, 9),
    rest=st.integers(1, 8),
    rounding=ROUNDINGS,
    under_way=st.sampled_from(["one", "many"]),
)
def test_slowed_down_by_beta_no_cycle_stalls_and_by_less_each_does(
    latency: int, s: int, rest: int, rounding: Rounding, under_way: Any
) -> None:
    horizon = s + rest
    slack = Replace(s, under_way).slack(ControlSetting(1000, horizon, rounding))
    # Ticks of 1000 ns, so that rounding to whole ns is little.
    latency_ns = constant(latency * 1000, 30)
    beta = slow_down(latency * 1e-6, slack, 1e-6)
    slowed = ControlSetting(1000, horizon, rounding).slowed(beta)
    assert not any(Replace(s, under_way).cycles(latency_ns, slowed).stall_ticks[12:])
    if beta > 1.01 and rounding == "ceil":
        hasty = ControlSetting(1000, horizon, rounding).slowed(beta * 0.995)
        assert Replace(s, under_way).ticks(latency_ns, hasty).stalled[-4 * horizon :].any()


def test_the_slack_h_less_s_is_not_enough_with_one_request_under_way() -> None:
    # H = 8, s = 1: slowed until d = 7 = H - s the next request waits for 7 ticks, and 7 + 7 > 8.
    slowed = ControlSetting(1000, 8, "ceil").slowed(slow_down(20e-6, 8 - 1, 1e-6))
    assert (Replace(1).cycles(constant(20_000), slowed).stall_ticks[2:-1] == 6).all()
    assert not Replace(1, "many").cycles(constant(20_000), slowed).stall_ticks[8:].any()
    with pytest.raises(ValueError, match="any speed"):
        slow_down(1.0, 0, 0.02)


def test_no_start_delay_helps_where_progress_asks() -> None:
    # H = 8, s = 6, d = 4. A robot that begins late asks late.
    setting = ControlSetting(PERIOD, 8)
    for first in (80, 800, 8000):
        latency_ns = np.concatenate(([first], constant(80)))
        assert (Replace(6).cycles(latency_ns, setting).stall_ticks[1:] == 2).all()
        assert (Aggregate(2).cycles(latency_ns, setting).stall_ticks[1:] == 2).all()


# (g) a wrong estimate


@given(latency=st.integers(0, 140), assumed=st.integers(0, 7), s=st.integers(1, 8), rounding=ROUNDINGS)
def test_a_fixed_estimate_makes_the_robot_jump_by_its_error(
    latency: int, assumed: int, s: int, rounding: Rounding
) -> None:
    setting = ControlSetting(PERIOD, 16, rounding)
    delay = int(setting.delay_ticks(np.array(latency)))
    made = Replace(s, "one", assumed)
    assume(max(s, -(-latency // PERIOD)) + assumed <= 16)
    assert made.cycles(constant(latency), setting).jump[1:-1].tolist() == [assumed - delay] * 6


@pytest.mark.parametrize(
    ("name", "latency"),
    [
        ("aggregate?trigger=8", 2),
        ("streamed?start=naive&gap_s=1", 2),
        ("replace?execute=2&under_way=many", 3),
        ("replace?assumed=2", 2),
    ],
)
def test_where_no_closed_form_holds_none_is_told(name: str, latency: int) -> None:
    assert mode(name).closed_form(constant(latency * PERIOD), ControlSetting(PERIOD, 16)) == Closed()


def test_appended_chunks_have_a_closed_form_while_answers_come_within_a_cycle() -> None:
    ready = np.array([2, 3])
    assert appended(ready, ready + 4, 0, 4) != Closed()
    assert appended(ready, ready + 5, 0, 4) == Closed()
