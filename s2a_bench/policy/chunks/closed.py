"""Closed forms: what a mode costs at a latency, without simulating; each says when it holds.

They are about the steady state, from the second request on, and of requests that do not overlap: one is
under way at a time, and L <= s Delta t unless said otherwise. Ticks are whole; d and ceil(L / Delta t), "known", are
what `ControlSetting` makes of a latency. In continuous time, on a robot whose ticks are shifted by a stall, d Delta t
is L.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from s2a_bench.policy import Floats
from s2a_bench.policy.chunks import Ints

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import ControlSetting, Mode


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


def closed(mode: Mode, latency_ns: Ints, setting: ControlSetting) -> Closed:
    """Return what the closed forms say of a mode at latencies of shape (R,), in ns, the first one's left out."""
    return mode.closed_form(latency_ns[1:], setting) if latency_ns.size > 1 else Closed()


def appended(ready: Ints, known: Ints, trigger: int, length: int) -> Closed:
    """Say it of chunks one after another, where the next request never has to wait for the answer."""
    wait = np.maximum(ready, trigger)
    cycle = wait + length - trigger
    return Closed() if (cycle < np.maximum(known, 1)).any() else Closed(stall_share(ready, trigger), wait, cycle)


def beta(mode: Mode, latency_ns: Ints, setting: ControlSetting, epsilon: float) -> float | None:
    """Return by how much actions would have to be slower for P(stall) <= epsilon; None for a mode without slack."""
    slack = mode.slack(setting)
    if slack is None or slack < 1:
        return None
    return slow_down(float(np.quantile(latency_ns, 1 - epsilon)) / 1e9, slack, setting.period_ns / 1e9)


def mean_reaction_s(wait_s: ArrayLike, cycle_s: ArrayLike) -> float:
    """Return the mean reaction time with random waits and cycles: E[w] + E[c^2] / (2 E[c]).

    An event falls into a long cycle more often than into a short one, so under sync a random latency costs
    Var(L) / (2 E[c]) more than its mean does. The wait belongs to the request after that cycle, and is taken to be
    independent of it.
    """
    wait, cycle = np.asarray(wait_s, dtype=np.float64), np.asarray(cycle_s, dtype=np.float64)
    return float(wait.mean() + np.square(cycle).mean() / (2 * cycle.mean()))


def slack_ticks(horizon: int, execute: int, under_way: Literal["one", "many"] = "one") -> int:
    """Return the greatest d without a stall under replace: H - s, and with one request under way at most H / 2.

    With one under way d may be above s; the cycle then lasts d ticks, and the chunk has to last for two delays (at
    whole L / Delta t; else known is d + 1 where actions leave at the end of their tick).
    """
    return min(horizon - execute, horizon // 2) if under_way == "one" else horizon - execute


def stall_share(delay_ticks: Ints, slack: int) -> float:
    """Return the share of delays above the slack: P(stall) per cycle, P(L > (H - s) Delta t) for replace.

    The slack is m for queue and aggregate, and H - s for replace *if no latency is above s Delta t*: one late answer
    puts the next request off, and the old chunk then has fewer than H - s actions left (`replace_stall_share`).
    """
    return float(np.mean(delay_ticks > slack))


def replace_stall_share(delay_ticks: Ints, known_ticks: Ints, execute: int, horizon: int) -> float:
    """Return P(max(s, known) + d' > H) over independent pairs: P(stall) of replace with one request under way.

    For delays of any size, d' being the next request's; what is given are samples of shape (R,), in any order.
    """
    cycle, times = np.unique(np.maximum(execute, known_ticks), return_counts=True)
    delay = np.sort(delay_ticks)
    above = delay.size - np.searchsorted(delay, horizon - cycle, "right")
    return float(above @ times / (delay.size * times.sum()))


def slow_down(latency_s: float, slack: int, period_s: float) -> float:
    """Return beta = max(1, L / (slack Delta t)): with actions so much slower, no cycle at this latency stalls.

    Where L exceeds the slack no start delay helps: a robot's progress is what the next request waits for, so that all
    of it is put off alike. Raises ValueError for a slack of 0, where no speed is slow enough.
    """
    if slack < 1:
        raise ValueError("without slack there is a stall at any speed")
    return max(1.0, latency_s / (slack * period_s))
