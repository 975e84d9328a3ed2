"""Every mode does in ticks what a robot in continuous time does, over arrays too; and the numbers of such a run."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.modes import MODES, ControlSetting, Mode, mode
from s2a_bench.plugins.chunks.modes.aggregate import WEIGHTS, Aggregate
from s2a_bench.plugins.chunks.modes.append import Queue, Streamed, Sync, VariedQueue
from s2a_bench.plugins.chunks.modes.cycles import follow, step
from s2a_bench.plugins.chunks.modes.metrics import margin_ticks, measure, reaction_ticks
from s2a_bench.plugins.chunks.modes.replace import Replace
from s2a_bench.plugins.chunks.modes.trigger import Varied
from s2a_bench.plugins.chunks.testing.mode import ModeSuite
from tests.conftest import examples
from tests.plugins.chunks.modes.plain import Aggregates, Appends, Log, Replaces

named = pytest.mark.parametrize("name", MODES)
many = settings(max_examples=examples(300))


def agree(some: tuple[Any, ...], others: tuple[Any, ...]) -> None:
    """Compare arrays field by field."""
    for one, other in zip(some, others, strict=True):
        for field in fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), field.name)


@st.composite
def settings_of_chunks(draw: st.DrawFn) -> ControlSetting:
    return ControlSetting(
        draw(st.sampled_from([1, 2, 7, 20])), draw(st.integers(1, 10)), draw(st.sampled_from(["floor", "ceil"]))
    )


@st.composite
def latencies(draw: st.DrawFn, setting: ControlSetting) -> Any:
    most = draw(st.sampled_from([1, 2, setting.horizon, 3 * setting.horizon])) * setting.period_ns
    return np.array(draw(st.lists(st.integers(0, most), max_size=12)), np.int64)


@st.composite
def modes(draw: st.DrawFn, setting: ControlSetting, name: str) -> Mode:
    execute, trigger = st.integers(1, setting.horizon), st.integers(0, setting.horizon + 2)
    if name == "sync":
        return mode(f"sync?execute={draw(execute)}")
    if name == "queue":
        return mode(f"queue?trigger={draw(trigger)}&execute={draw(execute)}")
    if name == "streamed":
        gap = draw(st.integers(0, 3 * setting.period_ns)) * 1e-9
        return Streamed(draw(trigger), draw(execute), gap, draw(st.sampled_from(["safe", "naive"])))
    if name == "replace":
        under_way = draw(st.sampled_from(["one", "many"]))
        return mode(f"replace?execute={draw(execute)}&under_way={under_way}&assumed={draw(st.integers(-1, 11))}")
    return mode(f"aggregate?trigger={draw(trigger)}&kind={draw(st.sampled_from(list(WEIGHTS)))}")


@st.composite
def cases(draw: st.DrawFn, name: str) -> tuple[Mode, Any, ControlSetting]:
    setting = draw(settings_of_chunks())
    return draw(modes(setting, name)), draw(latencies(setting)), setting


def plainly(made: Mode, latency_ns: Any, setting: ControlSetting) -> Log:
    common = (latency_ns.tolist(), setting.period_ns, setting.horizon, setting.rounding, made.gap_ns)
    match made:
        case Sync():
            return Appends(*common, execute=made.execution_horizon(setting)).run()
        case Queue():
            return Appends(*common, trigger=made.trigger, execute=made.execution_horizon(setting)).run()
        case Streamed():
            length = made.execution_horizon(setting)
            behind = max(0, (length - 1) * (made.gap_ns - setting.period_ns)) if made.start == "safe" else 0
            hold = -(-behind // setting.period_ns)
            return Appends(*common, trigger=made.trigger, execute=length, hold=hold).run()
        case Replace():
            return Replaces(*common, execute=made.execute, many=made.under_way == "many", assumed=made.assumed).run()
        case Aggregate():
            return Aggregates(*common, trigger=made.trigger, weight=WEIGHTS[made.kind]).run()
    raise AssertionError(made.name)


@named
@many
@given(data=st.data())
def test_ticks_are_those_of_a_robot_in_continuous_time(name: str, data: st.DataObject) -> None:
    made, latency_ns, setting = data.draw(cases(name))
    log, ticks, cycles = plainly(made, latency_ns, setting), *simulate(made, latency_ns, setting)
    expected = [act or (-1, -1) for act in log.acts[: cycles.ticks]]
    assert list(zip(ticks.chunk.tolist(), ticks.index.tolist(), strict=True)) == expected
    assert (cycles.request_tick * setting.period_ns).tolist() == log.asked_ns
    begun = next((tick for tick, act in enumerate(expected) if act != (-1, -1)), cycles.ticks)
    assert ticks.stalled.tolist() == [tick > begun and act == (-1, -1) for tick, act in enumerate(expected)]
    left_at = [at // setting.period_ns for at in log.asked_ns]
    ages = [tick - left_at[chunk] if chunk >= 0 else -1 for tick, (chunk, _) in enumerate(expected)]
    assert ticks.age.tolist() == ages


@named
@many
@given(data=st.data())
def test_the_stepper_and_the_arrays_agree(name: str, data: st.DataObject) -> None:
    made, latency_ns, setting = data.draw(cases(name))
    agree(simulate(made, latency_ns, setting)[::-1], step(made, latency_ns, setting))


@many
@given(data=st.data(), setting=settings_of_chunks())
def test_arrays_of_streamed_actions_are_the_stepper_s_at_any_gaps(data: st.DataObject, setting: ControlSetting) -> None:
    made, latency_ns = data.draw(modes(setting, "streamed")), data.draw(latencies(setting))
    most = data.draw(st.sampled_from([0, 1, setting.period_ns, 2 * setting.period_ns]))
    gap_ns = np.random.default_rng(data.draw(st.integers(0, 99))).integers(
        0, most + 1, (latency_ns.size, setting.horizon)
    )
    arrival_ns = latency_ns[:, np.newaxis] + np.cumsum(gap_ns, axis=1) - gap_ns[:, :1]
    arrays, stepped = made.arrays(arrival_ns, setting), follow(made, arrival_ns, setting)[0]
    length = made.execution_horizon(setting)
    waits = (np.diff(setting.delay_ticks(arrival_ns[:, :length])) > 1).any()
    assert arrays is not None or waits or made.trigger >= length
    if arrays is not None:
        agree((arrays,), (stepped,))


@named
@given(data=st.data())
def test_cycles_are_what_ticks_add_up_to(name: str, data: st.DataObject) -> None:
    made, latency_ns, setting = data.draw(cases(name))
    ticks, cycles = simulate(made, latency_ns, setting)
    assert len(ticks.chunk) == cycles.ticks
    np.testing.assert_array_equal(cycles.delay_ticks, setting.delay_ticks(latency_ns))
    for request in range(latency_ns.size):
        acted = np.flatnonzero(ticks.chunk == request)
        assert cycles.executed[request] == acted.size
        assert cycles.thrown_away[request] == setting.horizon - acted.size
        if not acted.size:
            assert cycles.start_tick[request] == cycles.ticks
            continue
        first = acted[0]
        assert (cycles.start_tick[request], cycles.first_index[request]) == (first, ticks.index[first])
        done = np.count_nonzero(ticks.chunk[cycles.request_tick[request] : first] >= 0)
        assert cycles.jump[request] == ticks.index[first] - done
    tail = np.argmax((ticks.chunk >= 0)[::-1]) if cycles.executed.any() else 0
    assert cycles.stall_ticks.sum() == ticks.stalled.sum() - tail
    assert cycles.settled.sum() == max(np.count_nonzero(cycles.executed) - 1, 0)


@many
@given(data=st.data())
def test_blended_ages_are_those_of_the_weights(data: st.DataObject) -> None:
    made, latency_ns, setting = data.draw(cases("aggregate"))
    assert isinstance(made, Aggregate)
    cycles = made.cycles(latency_ns, setting)
    log = plainly(made, latency_ns, setting)
    ages = [
        sum(share * (tick - log.asked_ns[chunk] // setting.period_ns) for chunk, share in blend.items())
        if blend
        else np.nan
        for tick, blend in enumerate(log.blends[: cycles.ticks])
    ]
    np.testing.assert_allclose(made.blended_age(cycles), ages, atol=1e-9)


def test_a_mode_by_hand() -> None:
    setting = ControlSetting(10, 4)
    queue = mode("queue?trigger=1").ticks(np.array([5, 25, 9]), setting)
    # Asked at 0 and usable at once; at 3 with one left, late by one tick; at 8.
    assert queue.chunk.tolist() == [0, 0, 0, 0, -1, 1, 1, 1, 1, 2, 2, 2]
    assert queue.index.tolist() == [0, 1, 2, 3, -1, 0, 1, 2, 3, 0, 1, 2]
    assert queue.age.tolist() == [0, 1, 2, 3, -1, 2, 3, 4, 5, 1, 2, 3]
    assert np.flatnonzero(queue.stalled).tolist() == [4]
    replace = mode("replace?execute=2")
    cycles = replace.cycles(np.array([15, 15, 35, 5]), setting)
    # Asked at 0, 3 (two ticks after it began), 5, and when the late third answer is known: 9; then nothing is left.
    assert cycles.request_tick.tolist() == [0, 3, 5, 9]
    assert replace.ticks(np.array([15, 15, 35, 5]), setting).chunk.tolist() == [-1, 0, 0, 0, 1, 1, 1, -1, 2, 3, 3]
    assert cycles.first_index.tolist() == [0, 1, 3, 0]
    assert cycles.jump.tolist() == [0, 0, 1, -0]
    assert cycles.stall_ticks.tolist() == [0, 0, 1, 0]
    assert cycles.executed.tolist() == [3, 3, 1, 2]


def test_a_latency_of_whole_ticks_is_one_delay_by_both_conventions() -> None:
    latency_ns = np.array([0, 1, 19, 20, 21, 40])
    assert ControlSetting(20, 4).delay_ticks(latency_ns).tolist() == [0, 0, 0, 1, 1, 2]
    assert ControlSetting(20, 4, "ceil").delay_ticks(latency_ns).tolist() == [0, 1, 1, 1, 2, 2]
    assert ControlSetting(20, 4).known_ticks(latency_ns).tolist() == [0, 1, 1, 1, 2, 2]


def test_time_scaling_takes_longer_ticks_and_never_shorter_ones_than_asked() -> None:
    assert ControlSetting(20, 4).slowed(1.26) == ControlSetting(26, 4)
    assert ControlSetting(20, 4).slowed(1.0) == ControlSetting(20, 4)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("wait", "`modes`: 'wait' is not one of sync, queue, streamed, replace, aggregate"),
        ("queue?trigger=-1", "`modes`: queue: trigger = '-1': input should be greater than or equal to 0"),
        ("replace?execute=0", "`modes`: replace: execute = '0'"),
    ],
)
def test_a_mode_that_is_none_is_refused(written: str, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        mode(written)
    assert message in str(caught.value)


def test_what_is_no_setting_is_refused() -> None:
    with pytest.raises(ValueError, match="period 0 ns"):
        ControlSetting(0, 4)
    with pytest.raises(ValueError, match="horizon 0"):
        ControlSetting(20, 0)
    with pytest.raises(ValueError, match="a latency of -1 ns"):
        ControlSetting(20, 4).delay_ticks(np.array([3, -1]))
    with pytest.raises(ValueError, match="execute = 5 of a chunk of 4"):
        Queue(0, 5).cycles(np.array([3]), ControlSetting(20, 4))


def simulate(made: Mode, latency_ns: Any, setting: ControlSetting) -> tuple[Any, Any]:
    return made.ticks(latency_ns, setting), made.cycles(latency_ns, setting)


@pytest.mark.parametrize(
    "written",
    [
        *MODES,
        "queue?trigger=9&execute=4",
        "streamed?trigger=2&gap_s=3e-8",
        "replace?execute=3&under_way=many",
        "replace?execute=2&assumed=3",
        "aggregate?trigger=7&kind=average",
    ],
)
class TestEachMode(ModeSuite):
    @pytest.fixture
    def mode(self, written: str) -> Mode:
        return mode(written)


@st.composite
def varied(draw: st.DrawFn) -> tuple[Varied, Any, ControlSetting]:
    setting = draw(settings_of_chunks())
    triggers = draw(st.lists(st.integers(0, setting.horizon), min_size=1, max_size=14))
    execute = draw(st.integers(0, setting.horizon))
    return VariedQueue(Queue(0, execute), tuple(triggers)), draw(latencies(setting)), setting


@many
@given(case=varied())
def test_its_arrays_and_its_stepper_agree(case: tuple[Varied, Any, ControlSetting]) -> None:
    mode, latency_ns, setting = case
    agree((mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting)), step(mode, latency_ns, setting))
    without_arrays = Varied(mode.mode, mode.triggers)
    agree((without_arrays.cycles(latency_ns, setting),), (mode.cycles(latency_ns, setting),))


@given(case=varied())
def test_with_one_trigger_it_is_queue(case: tuple[Varied, Any, ControlSetting]) -> None:
    mode, latency_ns, setting = case
    queue = mode.mode.varied(mode.triggers[:1])
    assert isinstance(queue, Queue)
    same = VariedQueue(mode.mode, mode.triggers[:1])
    agree((same.cycles(latency_ns, setting),), (queue.cycles(latency_ns, setting),))


SETTING = ControlSetting(10, 4)


def test_a_run_by_hand() -> None:
    latency_ns = np.array([15, 15, 35, 5])
    replace = Replace(2)
    # chunk -1 0 0 0 1 1 1 -1 2 3 3, requested at 0, 3, 5, 9
    found = measure(replace, replace.cycles(latency_ns, SETTING), replace.ticks(latency_ns, SETTING))
    assert (found.first_action_tick, found.ticks) == (1, 10)
    assert (found.stall_ticks, found.stall_share, found.longest_stall_ticks) == (1, 0.1, 1)
    assert found.p_stall_cycle == pytest.approx(1 / 3)
    ages = [1, 2, 3, 1, 2, 3, 3, 0, 1]
    assert found.age_ticks_mean == pytest.approx(np.mean(ages))
    assert (found.age_ticks_max, found.age_ticks_p99) == (3, pytest.approx(3))
    assert found.thrown_away_share == pytest.approx((1 + 1 + 3) / 12)
    assert (found.jump_mean, found.jump_max) == (pytest.approx(1 / 3), 1)
    assert found.blocked_ticks == 0


def test_only_a_blocking_robot_is_blocked() -> None:
    latency_ns = np.array([25, 15, 35])
    sync = Sync()
    found = measure(sync, sync.cycles(latency_ns, SETTING), sync.ticks(latency_ns, SETTING))
    assert (found.first_action_tick, found.stall_ticks, found.blocked_ticks) == (2, 4, 6)
    assert found.longest_stall_ticks == 3
    queue = Queue()
    assert measure(queue, queue.cycles(latency_ns, SETTING), queue.ticks(latency_ns, SETTING)).blocked_ticks == 0


def test_of_nothing_there_is_nothing_to_count() -> None:
    none = np.array([], np.int64)
    for name in MODES:
        mode = MODES[name]()
        found = measure(mode, mode.cycles(none, ControlSetting(10, 16)), mode.ticks(none, ControlSetting(10, 16)))
        assert (found.ticks, found.stall_ticks) == (0, 0)
        assert math.isnan(found.age_ticks_mean)
        assert math.isnan(found.p_stall_cycle)
        assert math.isnan(found.jump_max)


@pytest.mark.parametrize("name", MODES)
@given(data=st.data())
def test_reactions_are_those_of_the_first_chunk_observed_afterwards(name: str, data: st.DataObject) -> None:
    mode, latency_ns, setting = data.draw(cases(name))
    cycles, ticks = mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting)
    moments = np.linspace(0, cycles.ticks, 17)
    for moment, found in zip(moments, reaction_ticks(cycles, moments), strict=True):
        knowing = [t for t, chunk in enumerate(ticks.chunk) if chunk >= 0 and cycles.request_tick[chunk] >= moment]
        assert found == min(knowing) - moment if knowing else math.isnan(found)


def test_the_margin_is_the_greatest_added_delay_without_a_stall() -> None:
    latency_ns = np.array([20, 25, 10, 35, 20])
    setting = ControlSetting(10, 16)
    assert margin_ticks(Queue(5, 16), latency_ns, setting) == 2  # d is 3 at most
    assert margin_ticks(Queue(3, 16), latency_ns, setting) == 0
    assert margin_ticks(Queue(2, 16), latency_ns, setting) == -1
    assert margin_ticks(Replace(8), latency_ns, setting) == 5  # d = 3 + 5 is H - s
