"""Metrics of a simulation of chunks, in control ticks from the first action on.

The first request has no boundary: waiting for it is the time to first action, not a stall.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2a_bench.plugins.chunks.modes import ControlSetting, Cycles, Ints, Mode, Ticks
from s2a_bench.policy import Floats


@dataclass(frozen=True, slots=True)
class ChunkMetrics:
    """Metrics of one robot's run; undefined values are NaN."""

    first_action_tick: int
    """Time to first action; the run's length without one."""
    ticks: int
    """From the first action on."""
    stall_ticks: int
    stall_share: float
    """Of ``ticks``."""
    longest_stall_ticks: int
    p_stall_cycle: float
    """Share of the boundaries, from one executed chunk to the next, with a stall."""
    age_ticks_mean: float
    """Of the observation behind an executed action."""
    age_ticks_p99: float
    age_ticks_max: float
    thrown_away_share: float
    """Actions never executed, of all chunks but the last one executed and those after it."""
    jump_mean: float
    """Mean of |jump| over the boundaries."""
    jump_max: float
    blocked_ticks: int
    """Ticks in which the control loop waits for an answer, the first included; 0 unless the mode blocks."""


def measure(mode: Mode, cycles: Cycles, ticks: Ticks) -> ChunkMetrics:
    """Compute the metrics of a mode's run."""
    settled, age = cycles.settled, ticks.age[ticks.age >= 0]
    first = int(np.argmax(ticks.chunk >= 0)) if age.size else cycles.ticks
    stall_ticks, length = int(ticks.stalled.sum()), cycles.ticks - first
    last = int(np.flatnonzero(cycles.executed)[-1]) if age.size else 0
    jump, edges = np.abs(cycles.jump[settled]), np.diff(ticks.stalled.astype(np.int8), prepend=0, append=0)
    return ChunkMetrics(
        first_action_tick=first,
        ticks=length,
        stall_ticks=stall_ticks,
        stall_share=stall_ticks / length if length else np.nan,
        longest_stall_ticks=int((np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)).max(initial=0)),
        p_stall_cycle=mean(cycles.stall_ticks[settled] > 0),
        age_ticks_mean=mean(age),
        age_ticks_p99=p99(age),
        age_ticks_max=greatest(age),
        thrown_away_share=mean(cycles.thrown_away[:last]) / cycles.horizon,
        jump_mean=mean(jump),
        jump_max=greatest(jump),
        blocked_ticks=(stall_ticks + first) if mode.blocks else 0,
    )


def reaction_ticks(cycles: Cycles, moment_ticks: Floats) -> Floats:
    """Return the reaction times to events at moments (M,), in ticks.

    A reaction is the first action of a chunk observed at the event or later. An action counts at its tick's start; if
    it leaves at the end, one more tick passes. NaN for events after the last observation of an executed chunk.
    """
    used = np.flatnonzero(cycles.executed)
    place = np.searchsorted(cycles.request_tick[used], moment_ticks)
    start = np.append(cycles.start_tick[used].astype(np.float64), np.nan)
    return start[place] - moment_ticks


def margin_ticks(mode: Mode, latency_ns: Ints, setting: ControlSetting) -> int:
    """Return the stability margin: the ticks by which all latencies, shape (R,), may grow without any stall.

    -1 for a run that stalls without growth. A longer run has a smaller margin.
    """
    for added in range(2 * setting.horizon + 1):
        if mode.ticks(latency_ns + added * setting.period_ns, setting).stalled.any():
            return added - 1
    return 2 * setting.horizon


def mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else np.nan


def p99(values: NDArray[Any]) -> float:
    return float(np.quantile(values, 0.99)) if values.size else np.nan


def greatest(values: NDArray[Any]) -> float:
    return float(values.max()) if values.size else np.nan
