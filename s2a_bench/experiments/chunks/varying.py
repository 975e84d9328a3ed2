"""What is varied besides the modes as asked for: every trigger of queue, and replace over latency and s."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.experiments.chunks.closed import closed, execution_horizon
from s2a_bench.experiments.chunks.rows import StabilityRow, TriggerRow
from s2a_bench.experiments.chunks.to_rows import interval
from s2a_bench.policy.chunks.append import Queue
from s2a_bench.policy.chunks.replace import Replace
from s2a_bench.policy.parameters import canonical

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import Drawn
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.policy.chunks import Cycles

MOST_POINTS: Final = 64
"""Triggers, or execution horizons, that are tried of a longer chunk."""
REQUESTS: Final = 500
"""Of a point of the stability diagram."""


def trigger_rows(config: ChunksConfig, drawn: Drawn) -> Iterator[TriggerRow]:
    """Try every trigger of the first queue; none where there is no queue."""
    queue = next((mode for mode in config.made.values() if isinstance(mode, Queue)), None)
    if queue is None:
        return
    setting = config.setting
    length = execution_horizon(queue, setting)
    for trigger in _steps(0, length - 1):
        mode = replace(queue, trigger=trigger)
        cycles = mode.cycles(drawn.judged, setting)
        settled = cycles.settled
        stalled, boundaries = int((cycles.stall_ticks[settled] > 0).sum()), int(settled.sum())
        low, high = interval(stalled, boundaries)
        if low is not None and high is not None:
            yield TriggerRow(
                latency=drawn.source.name,
                mode=canonical("queue", replace(queue, trigger=0)),
                execution_horizon=length,
                trigger=trigger,
                boundaries=boundaries,
                p_stall_cycle=stalled / boundaries,
                p_stall_low=low,
                p_stall_high=high,
                p_stall_closed=closed(mode, drawn.judged, setting).p_stall,
                age_ticks_mean=mean_age(cycles),
            )


def stability_rows(config: ChunksConfig, drawn: Drawn) -> Iterator[StabilityRow]:
    """Try the first replace over mean latency and execution horizon; none where there is no replace."""
    mode = next((mode for mode in config.made.values() if isinstance(mode, Replace)), None)
    if mode is None or not config.stability:
        return
    setting, shape = config.setting, drawn.judged[:REQUESTS] / max(float(drawn.judged[:REQUESTS].mean()), 1.0)
    for mean_ns in np.linspace(0, setting.horizon * setting.period_ns, config.stability):
        latency_ns = np.rint(shape * mean_ns).astype(np.int64)
        for execute in _steps(1, setting.horizon):
            cycles = replace(mode, execute=execute).cycles(latency_ns, setting)
            length = cycles.ticks - int(cycles.start_tick.min())
            settled = cycles.settled
            executed = int(cycles.executed.sum())
            yield StabilityRow(
                latency=drawn.source.name,
                mode=canonical("replace", replace(mode, execute=8)),
                latency_s=mean_ns / 1e9,
                execution_horizon=execute,
                requests=latency_ns.size,
                stall_share=1 - executed / length if executed else None,
                p_stall_cycle=float((cycles.stall_ticks[settled] > 0).mean()) if settled.any() else None,
            )


def mean_age(cycles: Cycles) -> float:
    """Return the mean age of the observation behind executed actions, in ticks, of chunks executed in one run each."""
    middle = cycles.start_tick - cycles.request_tick + (cycles.executed - 1) / 2
    return float(np.average(middle, weights=cycles.executed))


def _steps(first: int, last: int) -> list[int]:
    return [int(step) for step in np.unique(np.linspace(first, last, min(last - first + 1, MOST_POINTS)).round())]
