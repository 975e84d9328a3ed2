"""From when each chunk takes over to what that means: the part that all modes with arrays share.

A chunk that is executed at all is executed in one run of ticks, and runs follow one another; between them lie stalls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.policy.chunks import Cycles, Mode, Setting, Ticks

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import Ints


class Laid(Mode):
    """A mode with arrays for `cycles`, in which every chunk is one run: its ticks follow from that."""

    def ticks(self, latency_ns: Ints, setting: Setting) -> Ticks:
        """Say what each tick does."""
        return lay(self.cycles(latency_ns, setting))


def assemble(
    request_tick: Ints, usable_tick: Ints, start_tick: Ints, first_index: Ints, until: Ints, *, ticks: int, horizon: int
) -> Cycles:
    """Make cycles of runs: chunk r is executed from ``start_tick`` until before ``until``, both of shape (R,)."""
    executed: Ints = np.clip(np.minimum(until, ticks) - start_tick, 0, None)
    used = np.flatnonzero(executed)
    start, length = start_tick[used], executed[used]
    stall_ticks, jump = np.zeros((2, request_tick.size), np.int64)
    stall_ticks[used[1:]] = start[1:] - start[:-1] - length[:-1]
    done_before = np.cumsum(length) - length
    jump[used] = first_index[used] - (done_before - _executed_before(request_tick[used], start, length, done_before))
    return Cycles(
        request_tick=request_tick,
        usable_tick=usable_tick,
        start_tick=np.where(executed > 0, start_tick, ticks),
        first_index=np.where(executed > 0, first_index, 0),
        executed=executed,
        stall_ticks=stall_ticks,
        jump=jump,
        ticks=ticks,
        horizon=horizon,
    )


def gather(request_tick: Ints, usable_tick: Ints, chunk: Ints, index: Ints, horizon: int) -> tuple[Cycles, Ticks]:
    """Make cycles and ticks of what each tick executed, both of shape (K,), -1 for nothing; runs may be broken."""
    count, ticks = request_tick.size, chunk.size
    acted = np.flatnonzero(chunk >= 0)
    by = chunk[acted]
    start_tick, first_index = np.full(count, ticks), np.zeros(count, np.int64)
    seen, place = np.unique(by, return_index=True)
    start_tick[seen], first_index[seen] = acted[place], index[acted[place]]
    stall_ticks, jump = np.zeros((2, count), np.int64)
    np.add.at(stall_ticks, by[1:], np.diff(acted) - 1)
    since = np.searchsorted(acted, start_tick[seen]) - np.searchsorted(acted, request_tick[seen])
    jump[seen] = first_index[seen] - since
    executed = np.bincount(by, minlength=count).astype(np.int64)
    cycles = Cycles(
        request_tick, usable_tick, start_tick, first_index, executed, stall_ticks, jump, ticks=ticks, horizon=horizon
    )
    age = np.where(chunk >= 0, np.arange(ticks) - request_tick[chunk], -1) if count else chunk
    return cycles, Ticks(chunk, index, age, _stalled(chunk))


def lay(cycles: Cycles) -> Ticks:
    """Lay runs out tick by tick."""
    used = np.flatnonzero(cycles.executed)
    start, length = cycles.start_tick[used], cycles.executed[used]
    end = start + length
    spans = np.empty(2 * used.size + 1, np.int64)  # idle, run, idle, run, ..., idle
    spans[1::2] = length
    spans[0:-1:2] = start - np.concatenate(([0], end[:-1]))
    spans[-1] = cycles.ticks - (end[-1] if used.size else 0)
    idle = np.full(spans.size, -1, np.int64)

    def spread(values: Ints) -> Ints:
        each = idle.copy()
        each[1::2] = values
        return np.repeat(each, spans)

    chunk, tick = spread(used), np.arange(cycles.ticks)
    nothing = chunk < 0
    index, age = tick - spread(start - cycles.first_index[used]), tick - spread(cycles.request_tick[used])
    index[nothing], age[nothing] = -1, -1
    stalled = nothing
    stalled[: start[0] if used.size else cycles.ticks] = False
    return Ticks(chunk, index, age, stalled)


def _executed_before(tick: Ints, start: Ints, length: Ints, done_before: Ints) -> Ints:
    """Return how many actions had been executed before each tick."""
    run = np.searchsorted(start, tick, "right") - 1
    inside = np.minimum(tick - start[run], length[run])
    return np.where(run < 0, 0, done_before[run] + inside)


def _stalled(chunk: Ints) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    begun = np.maximum.accumulate(chunk >= 0) if chunk.size else chunk >= 0
    return np.asarray(begun & (chunk < 0))
