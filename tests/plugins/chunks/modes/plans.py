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
