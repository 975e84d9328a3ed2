"""Chunks as plans whose pieces all take Delta t, for which policies over skills decide unchanged, and their S0."""

from __future__ import annotations

import numpy as np

from s2a_bench.plugins.chunks.modes import Ints
from s2a_bench.policy import Plans

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


def earliest_arrivals(request_tick: Ints, delay_ticks: Ints, horizon: int) -> Ints:
    """Return t_j for every tick j up to the last that is covered: the earliest arrival of an action due then, in ticks.

    Requests of shape (R,), sorted; chunk r has the actions due at request_tick[r], ..., + H - 1, all of them usable at
    request_tick[r] + delay_ticks[r]. The result counts from the first request, and has the greatest int64 for a tick
    that no chunk covers.
    """
    first = int(request_tick[0])
    earliest = np.full(int(request_tick[-1]) - first + horizon, np.iinfo(np.int64).max)
    for index in range(horizon):
        np.minimum.at(earliest, request_tick - first + index, request_tick - first + delay_ticks)
    return earliest


def safe_start_ticks(earliest: Ints) -> int:
    """Return S0 = max_j (t_j - j) in ticks: executing action j at S0 + j stalls never, at any start before it does."""
    return int(np.max(earliest - np.arange(earliest.size)))
