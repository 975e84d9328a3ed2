"""Closed forms that nothing measures with: simulations and robots in continuous time are compared with them.

They are about the steady state, as those of `s2a_bench.plugins.chunks.modes.closed`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from s2a_bench.plugins.chunks.modes import Ints
from s2a_bench.policy import Floats


@dataclass(frozen=True, slots=True)
class Span:
    """Least, mean and greatest of an evenly spread number."""

    least: float
    mean: float
    most: float


def queue_stall_ticks(delay_ticks: Ints, trigger: int) -> Ints:
    """Return max(0, d - m): the stall at each boundary under queue, and under aggregate too.

    For m < s with latencies of any size, each cycle by itself; `steady_stall_ticks` is for any m. In aggregate s is
    H - m, and m < H / 2. Sync is m = 0.
    """
    return np.maximum(0, delay_ticks - trigger)


def steady_stall_ticks(ready_ticks: Ints, known_ticks: Ints, trigger: int, execute: int) -> Ints:
    """Return max(0, ready - m, known - s), the stall at each boundary of queue and streamed at constant latency.

    For any m. A chunk may begin ``ready`` ticks after its request: d, and for streamed S0 in ticks; ``known`` is when
    the next request may follow from its last action. known - s is what no trigger helps against: one answer at a time
    takes longer than its actions last, as actions that arrive more slowly than they are executed always do.
    """
    return np.maximum(np.maximum(0, ready_ticks - trigger), known_ticks - execute)


def replace_stall_ticks(delay_ticks: Ints, cycle_ticks: ArrayLike, horizon: int) -> Ints:
    """Return min(c, max(0, c + d - H)), the stall between a chunk's takeover and the next one's, at constant d.

    c is s, or max(s, known) where the next request waits for the answer: with d > s and one request under way a cycle
    is longer than s, and stalls longer than s + d - H says. The bound c is met where d >= H: every action is past.
    """
    cycle = np.asarray(cycle_ticks, dtype=np.int64)
    return np.asarray(np.minimum(cycle, np.maximum(0, cycle + delay_ticks - horizon)))


def replace_age_ticks(delay: int, cycle: int, horizon: int) -> Span:
    """Return the age of the observation behind the executed actions: d to c + d - 1 ticks, mean d + (c - 1) / 2.

    Where the chunk runs out before (c + d > H), d to H - 1. With d >= H nothing is executed.
    """
    last = min(cycle + delay, horizon) - 1
    return Span(delay, (delay + last) / 2, last)


def queue_age_ticks(delay: int, trigger: int, execute: int) -> Span:
    """Return the same under queue, where nothing is skipped: max(m, d) to max(m, d) + s - 1; as `queue_stall_ticks`."""
    first = max(delay, trigger)
    return Span(first, first + (execute - 1) / 2, first + execute - 1)


def reaction_s(wait_s: float, cycle_s: float) -> Span:
    """Return the time from an event at a uniform moment to the first action that knows of it: U(w, w + c).

    w is from observation to takeover and c from request to request, both constant: L and s Delta t for replace; for
    queue max(L, m Delta t) and s Delta t + its stall, since m actions are executed first; for sync L and s Delta t + L,
    whose mean is 1.5 L + s Delta t / 2.
    """
    return Span(wait_s, wait_s + cycle_s / 2, wait_s + cycle_s)


def start_s(first_s: ArrayLike, gap_s: ArrayLike, actions: int, period_s: float) -> Floats:
    """Return S0 of actions that arrive evenly: TTFA + (H - 1) max(0, delta - Delta t); ``actions`` is H."""
    slower = np.maximum(0.0, np.asarray(gap_s, dtype=np.float64) - period_s)
    return np.asarray(np.asarray(first_s, dtype=np.float64) + (actions - 1) * slower)


def jump_actions(assumed_ticks: Ints, delay_ticks: Ints) -> Ints:
    """Return |d_hat - d|: by so many actions the robot jumps where chunks take over at a fixed index.

    Where it did not stall since the observation; after a stall only actions that were executed count, not d.
    """
    return np.asarray(np.abs(assumed_ticks - delay_ticks))
