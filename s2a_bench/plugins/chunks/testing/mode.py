"""The conformance suite of modes of acting on chunks."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeAlias

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.chunks.modes import MODES, ControlSetting, Mode
from s2a_bench.plugins.chunks.modes.cycles import step
from s2a_bench.testing.policy import shared

Case: TypeAlias = tuple[Any, ControlSetting]


def draw(seed: int, horizon: int, requests: int, longest: float, *, floor: bool) -> Case:
    """Make latencies of up to ``longest`` chunks, now and then of whole ticks."""
    rng = np.random.default_rng(seed)
    setting = ControlSetting(int(rng.integers(1, 21)), horizon, "floor" if floor else "ceil")
    latency_ns = rng.integers(0, 1 + int(longest * horizon * setting.period_ns), requests)
    whole = rng.random(requests) < 0.3
    return np.where(whole, latency_ns // setting.period_ns * setting.period_ns, latency_ns), setting


cases = st.builds(
    draw,
    seed=st.integers(0, 2**32 - 1),
    horizon=st.integers(8, 20),
    requests=st.integers(0, 12),
    longest=st.sampled_from([0.1, 0.5, 1.5]),
    floor=st.booleans(),
)


class ModeSuite:
    """Fixture: ``mode``, whose name is in `MODES` and which needs no chunk of more than 8 actions."""

    def test_its_name_is_the_one_it_is_found_by(self, mode: Mode) -> None:
        assert mode.name in MODES

    @shared
    @given(case=cases)
    def test_the_stepper_and_the_arrays_agree(self, mode: Mode, case: Case) -> None:
        arrays: tuple[Any, ...] = mode.cycles(*case), mode.ticks(*case)
        for array, stepped in zip(arrays, step(mode, *case), strict=True):
            for field in fields(array):
                np.testing.assert_array_equal(getattr(array, field.name), getattr(stepped, field.name), field.name)

    @shared
    @given(case=cases)
    def test_its_pace_is_when_it_asks(self, mode: Mode, case: Case) -> None:
        latency_ns, setting = case
        if (pace := mode.pace(setting)) is not None:
            delays = zip(setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns), strict=True)
            ticks = [tick for tick, _ in (next(pace), *map(pace.send, delays))]
            cycles = mode.cycles(*case)
            assert ticks == [*cycles.request_tick, cycles.ticks]

    @shared
    @given(case=cases)
    def test_it_asks_at_once_and_then_at_most_once_a_tick(self, mode: Mode, case: Case) -> None:
        request_tick = mode.cycles(*case).request_tick
        assert request_tick.size == case[0].size
        assert (request_tick[:1] == 0).all()
        assert (np.diff(request_tick) > 0).all()

    @shared
    @given(case=cases)
    def test_no_action_is_executed_before_it_has_arrived(self, mode: Mode, case: Case) -> None:
        latency_ns, setting = case
        cycles, ticks = mode.cycles(*case), mode.ticks(*case)
        acted = np.flatnonzero(ticks.chunk >= 0)
        chunk, index = ticks.chunk[acted], ticks.index[acted]
        usable = cycles.request_tick[chunk] + setting.delay_ticks(latency_ns[chunk] + index * mode.gap_ns)
        assert (acted >= usable).all()

    @shared
    @given(case=cases)
    def test_chunks_follow_one_another_and_so_do_their_actions(self, mode: Mode, case: Case) -> None:
        ticks = mode.ticks(*case)
        chunk, index = (each[ticks.chunk >= 0] for each in (ticks.chunk, ticks.index))
        newer = np.diff(chunk)
        assert (newer >= 0).all()
        assert (np.diff(index)[newer == 0] > 0).all()
        assert (index < case[1].horizon).all()

    @shared
    @given(case=cases)
    def test_what_it_does_hangs_on_no_later_latency(self, mode: Mode, case: Case) -> None:
        latency_ns, setting = case
        whole = mode.ticks(latency_ns, setting)
        for count in range(latency_ns.size):
            ticks = mode.ticks(latency_ns[:count], setting)
            np.testing.assert_array_equal(ticks.chunk, whole.chunk[: ticks.chunk.size])
            np.testing.assert_array_equal(ticks.index, whole.index[: ticks.chunk.size])

    def test_simulating_leaves_the_latencies_as_they_are(self, mode: Mode) -> None:
        latency_ns, setting = draw(1, 9, 6, 0.5, floor=True)
        before = latency_ns.copy()
        mode.cycles(latency_ns, setting)
        mode.ticks(latency_ns, setting)
        np.testing.assert_array_equal(latency_ns, before)

    def test_following_one_robot_leaves_nothing_behind_for_the_next(self, mode: Mode) -> None:
        case, other = draw(2, 9, 6, 0.5, floor=True), draw(3, 9, 6, 1.5, floor=True)
        first = step(mode, *case)[1]
        step(mode, *other)
        np.testing.assert_array_equal(step(mode, *case)[1].chunk, first.chunk)
