"""Closed forms: the cost of a mode at a latency without simulation, with the conditions under which each holds.

They hold in the steady state, from the second request on, with one request pending at a time and L <= s Delta t unless
a docstring allows more. Ticks are whole; `ControlSetting` computes d and ceil(L / Delta t), "known". In continuous
time, on a robot whose ticks are shifted by a stall, d Delta t is L.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from s2a_bench.plugins.chunks.modes import ControlSetting, Ints, Mode
from s2a_bench.policy import Floats


@dataclass(frozen=True, slots=True)
class Closed:
    """P(stall), and each request's wait from observation to takeover and cycle until the next request, in ticks.

    None where no closed form holds.
    """

    p_stall: float | None = None
    wait_ticks: Ints | None = None
    cycle_ticks: Ints | None = None

    @property
    def mean_reaction_ticks(self) -> float | None:
        """Return the mean reaction time with random waits and cycles: E[w] + E[c^2] / (2 E[c]).

        An event falls into a long cycle more often than into a short one, so under sync a random latency costs
        Var(L) / (2 E[c]) more than its mean. The wait is that of the request after the cycle, assumed independent.
        """
        if self.wait_ticks is None or self.cycle_ticks is None:
            return None
        cycle = self.cycle_ticks.astype(np.float64)
        return float(self.wait_ticks.mean() + np.square(cycle).mean() / (2 * cycle.mean()))

    def reaction_ticks(self, shares: Floats) -> Floats | None:
        """Return the quantiles of the time from an event at a uniform moment to the reaction, for shares of any shape.

        The probability that an event falls into a cycle is proportional to its length. The reaction takes the rest of
        the cycle and the next request's wait: U(w, w + c) for constant waits and cycles. Both are whole ticks, so the
        distribution is linear between them.
        """
        from scipy.signal import convolve

        if self.wait_ticks is None or self.cycle_ticks is None:
            return None
        rest = np.arange(int(self.cycle_ticks.max()) + 1)
        longer = np.bincount(self.cycle_ticks, minlength=rest.size)[::-1].cumsum()[::-1]  # cycles of k ticks or more
        within = longer[1:] / self.cycle_ticks.sum()  # probability of an event k to k + 1 ticks before the next cycle
        least = int(self.wait_ticks.min())
        waits = np.bincount(self.wait_ticks - least) / self.wait_ticks.size
        together = np.maximum(convolve(waits, within), 0)  # by FFT for many ticks
        reached = np.concatenate(([0.0], np.cumsum(together)))
        quantiles: Floats = np.interp(shares, reached, least + np.arange(reached.size))
        return quantiles


def closed(mode: Mode, latency_ns: Ints, setting: ControlSetting) -> Closed:
    """Return the closed forms of a mode at latencies of shape (R,), in ns, without the first."""
    return mode.closed_form(latency_ns[1:], setting) if latency_ns.size > 1 else Closed()


def appended(ready: Ints, known: Ints, trigger: int, length: int) -> Closed:
    """Return the closed forms of appended chunks, if the next request never has to wait for the answer."""
    wait = np.maximum(ready, trigger)
    cycle = wait + length - trigger
    spare = cycle - np.maximum(known, 1)
    if (spare < 0).any():
        return Closed()
    p_stall = stall_share(ready, trigger)
    # without spare ticks a queue that begins below its trigger never fills up to it, so waits are shorter
    return Closed(p_stall) if (spare[ready < trigger] == 0).any() else Closed(p_stall, wait, cycle)


def beta(mode: Mode, latency_ns: Ints, setting: ControlSetting, epsilon: float) -> float | None:
    """Return the factor by which actions must be slower for P(stall) <= epsilon; None for a mode without slack."""
    slack = mode.slack(setting)
    if slack is None or slack < 1:
        return None
    return slow_down(float(np.quantile(latency_ns, 1 - epsilon)) / 1e9, slack, setting.period_ns / 1e9)


def stall_share(delay_ticks: Ints, slack: int) -> float:
    """Return the share of delays above the slack: P(stall) per cycle, P(L > (H - s) Delta t) for replace.

    The slack is m for queue and aggregate, and H - s for replace *if no latency exceeds s Delta t*: a later answer
    delays the next request, when the old chunk has fewer than H - s actions left (`replace_stall_share`).
    """
    return float(np.mean(delay_ticks > slack))


def replace_stall_share(delay_ticks: Ints, known_ticks: Ints, execute: int, horizon: int) -> float:
    """Return P(max(s, known) + d' > H) over independent pairs: P(stall) of replace with one pending request.

    It holds for all delays; d' is the next request's. The arguments are samples of shape (R,), in any order.
    """
    cycle, times = np.unique(np.maximum(execute, known_ticks), return_counts=True)
    delay = np.sort(delay_ticks)
    above = delay.size - np.searchsorted(delay, horizon - cycle, "right")
    return float(above @ times / (delay.size * times.sum()))


def slow_down(latency_s: float, slack: int, period_s: float) -> float:
    """Return beta = max(1, L / (slack Delta t)): with actions so much slower, no cycle at this latency stalls.

    If L exceeds the slack no start delay helps: it delays the next request as much. Raises ValueError for a slack of 0,
    where no speed is slow enough.
    """
    if slack < 1:
        raise ValueError("without slack there is a stall at any speed")
    return max(1.0, latency_s / (slack * period_s))
