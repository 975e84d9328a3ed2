"""A queue whose trigger varies: its arrays against its stepper, and against queue where it does not vary."""

from __future__ import annotations

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from s2a_bench.plugins.chunks.modes import ControlSetting
from s2a_bench.plugins.chunks.modes.append import Queue, VariedQueue
from s2a_bench.plugins.chunks.modes.cycles import step
from s2a_bench.plugins.chunks.modes.trigger import Varied
from tests.plugins.chunks.modes.drawn import agree, latencies, settings_of_chunks


@st.composite
def varied(draw: st.DrawFn) -> tuple[Varied, Any, ControlSetting]:
    setting = draw(settings_of_chunks())
    triggers = draw(st.lists(st.integers(0, setting.horizon), min_size=1, max_size=14))
    execute = draw(st.integers(0, setting.horizon))
    return VariedQueue(Queue(0, execute), tuple(triggers)), draw(latencies(setting)), setting


@settings(max_examples=300)
@given(case=varied())
def test_its_arrays_and_its_stepper_agree(case: tuple[Varied, Any, ControlSetting]) -> None:
    mode, latency_ns, setting = case
    agree((mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting)), step(mode, latency_ns, setting))


@given(case=varied())
def test_with_one_trigger_it_is_queue(case: tuple[Varied, Any, ControlSetting]) -> None:
    mode, latency_ns, setting = case
    queue = mode.mode.varied(mode.triggers[:1])
    assert isinstance(queue, Queue)
    same = VariedQueue(mode.mode, mode.triggers[:1])
    agree((same.cycles(latency_ns, setting),), (queue.cycles(latency_ns, setting),))


@given(case=varied())
def test_a_mode_without_arrays_of_its_own_does_the_same(case: tuple[Varied, Any, ControlSetting]) -> None:
    mode, latency_ns, setting = case
    stepped = Varied(mode.mode, mode.triggers)
    agree((stepped.cycles(latency_ns, setting),), (mode.cycles(latency_ns, setting),))
