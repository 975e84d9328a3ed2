"""The numbers of a run with chunks, by hand and against counting."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.chunks.modes import MODES, ControlSetting
from s2a_bench.plugins.chunks.modes.append import Queue, Sync
from s2a_bench.plugins.chunks.modes.metrics import margin_ticks, measure, reaction_ticks
from s2a_bench.plugins.chunks.modes.replace import Replace
from tests.plugins.chunks.modes.drawn import cases

SETTING = ControlSetting(10, 4)


def test_a_run_by_hand() -> None:
    latency_ns = np.array([15, 15, 35, 5])
    replace = Replace(2)
    # chunk -1 0 0 0 1 1 1 -1 2 3 3, requested at 0, 3, 5, 9
    found = measure(replace, replace.cycles(latency_ns, SETTING), replace.ticks(latency_ns, SETTING))
    assert (found.first_action_tick, found.ticks, found.requests) == (1, 10, 4)
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
        assert (found.ticks, found.requests, found.stall_ticks) == (0, 0, 0)
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
