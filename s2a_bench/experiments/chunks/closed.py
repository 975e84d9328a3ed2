"""What the closed forms say of a mode at given delays: P(stall) a cycle, and from observation to reaction.

Each holds where `policy.chunks.closed` says so; elsewhere there is None.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.policy.chunks.aggregate import Aggregate
from s2a_bench.policy.chunks.append import Queue, Streamed, Sync
from s2a_bench.policy.chunks.closed import mean_reaction_s, replace_stall_share, slack_ticks, slow_down, stall_share
from s2a_bench.policy.chunks.replace import Replace
from s2a_bench.policy.chunks.varied import Varied

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Ints, Mode, Setting


@dataclass(frozen=True, slots=True)
class Closed:
    """P(stall), and each request's wait from observation to takeover and cycle until the next request, in ticks."""

    p_stall: float | None = None
    wait_ticks: Ints | None = None
    cycle_ticks: Ints | None = None

    @property
    def mean_reaction_ticks(self) -> float | None:
        """Return E[w] + E[c^2] / (2 E[c])."""
        if self.wait_ticks is None or self.cycle_ticks is None:
            return None
        return mean_reaction_s(self.wait_ticks, self.cycle_ticks)

    def reaction_ticks(self, shares: Floats) -> Floats | None:
        """Return the quantiles of the time from an event at a uniform moment to the reaction, for shares of any shape.

        An event falls into a cycle with a chance in proportion to its length, anywhere within it; what is left of the
        cycle and the next request's wait add up. For constant waits and cycles it is U(w, w + c). Both are whole ticks,
        so that the distribution is linear between them.
        """
        from scipy.signal import convolve

        if self.wait_ticks is None or self.cycle_ticks is None:
            return None
        rest = np.arange(int(self.cycle_ticks.max()) + 1)
        longer = np.bincount(self.cycle_ticks, minlength=rest.size)[::-1].cumsum()[::-1]  # cycles of k ticks or more
        within = longer[1:] / self.cycle_ticks.sum()  # of an event k to k + 1 ticks before the next one
        least = int(self.wait_ticks.min())
        waits = np.bincount(self.wait_ticks - least) / self.wait_ticks.size
        together = np.maximum(convolve(waits, within), 0)  # by FFT where many ticks would take minutes otherwise
        reached = np.concatenate(([0.0], np.cumsum(together)))
        found: Floats = np.interp(shares, reached, least + np.arange(reached.size))
        return found


def execution_horizon(mode: Mode, setting: Setting) -> int:
    """Return s: for how many ticks a chunk is to be executed, of aggregate H - m."""
    if isinstance(mode, Aggregate):
        return max(0, setting.horizon - mode.trigger)
    return getattr(mode, "execute", 0) or setting.horizon


def assumed_ticks(mode: Mode) -> float | None:
    """Return the d that a mode is ready for: its trigger, or what replace assumes; None where it assumes nothing."""
    if isinstance(mode, Sync):
        return 0.0
    if isinstance(mode, Replace):
        return None if mode.assumed < 0 else float(mode.assumed)
    found: int | None = None if isinstance(mode, Streamed) else getattr(mode, "trigger", None)
    return None if found is None else float(found)


def beta(mode: Mode, latency_ns: Ints, setting: Setting, epsilon: float) -> float | None:
    """Return by how much actions would have to be slower for P(stall) <= epsilon; None for a mode without slack."""
    if isinstance(mode, Replace):
        slack = slack_ticks(setting.horizon, mode.execute, mode.under_way)
    elif isinstance(mode, Queue | Varied):
        slack = execution_horizon(mode, setting) - 1
    else:
        return None
    if slack < 1:
        return None
    return slow_down(float(np.quantile(latency_ns, 1 - epsilon)) / 1e9, slack, setting.period_ns / 1e9)


def closed(mode: Mode, latency_ns: Ints, setting: Setting) -> Closed:
    """Return what the closed forms say of latencies of shape (R,), in ns, the first one's left out."""
    delay, known = setting.delay_ticks(latency_ns[1:]), setting.known_ticks(latency_ns[1:])
    length = execution_horizon(mode, setting)
    if not delay.size:
        return Closed()
    if isinstance(mode, Replace):
        return _replace(mode, delay, known, setting.horizon)
    if isinstance(mode, Aggregate):
        return _aggregate(mode, delay, setting.horizon)
    if isinstance(mode, Streamed):
        if mode.start == "naive" and mode.gap_ns > setting.period_ns:
            return Closed()
        known = setting.known_ticks(latency_ns[1:] + (length - 1) * mode.gap_ns)
        return _append(delay + mode.hold_ticks(setting), known, mode.trigger, length)
    trigger = mode.trigger if isinstance(mode, Queue) else 0 if isinstance(mode, Sync) else None
    return Closed() if trigger is None else _append(delay, known, trigger, length)


def _append(ready: Ints, known: Ints, trigger: int, length: int) -> Closed:
    """Return the same of queue, sync and streamed, where the next request never has to wait for the answer."""
    wait = np.maximum(ready, trigger)
    cycle = wait + length - trigger
    return Closed() if (cycle < np.maximum(known, 1)).any() else Closed(stall_share(ready, trigger), wait, cycle)


def _aggregate(mode: Aggregate, delay: Ints, horizon: int) -> Closed:
    if 2 * mode.trigger >= horizon:
        return Closed()
    cycle = delay + horizon - np.minimum(delay, mode.trigger) - mode.trigger
    return Closed(stall_share(delay, mode.trigger), delay, cycle)


def _replace(mode: Replace, delay: Ints, known: Ints, horizon: int) -> Closed:
    if mode.assumed >= 0:
        return Closed()
    if mode.under_way == "one":
        share = replace_stall_share(delay, known, mode.execute, horizon)
        cycle = np.maximum(mode.execute, known)
    elif delay.max() > mode.execute:
        return Closed()
    else:
        share, cycle = stall_share(delay, horizon - mode.execute), np.full_like(delay, mode.execute)
    return Closed(share, delay, cycle) if delay.max() < horizon else Closed(share)
