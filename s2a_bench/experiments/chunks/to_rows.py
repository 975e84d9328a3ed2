"""A simulated cell as rows: its metrics, its first ticks, its first requests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.chunks.closed import assumed_ticks, beta, closed, execution_horizon
from s2a_bench.experiments.chunks.metrics import METRICS
from s2a_bench.experiments.chunks.rows import AboutCell, ChunkRow, RequestRow, TickRow
from s2a_bench.policy.chunks.metrics import margin_ticks, measure, reaction_ticks
from s2a_bench.policy.conformal import upper_bound

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import Cell
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Cycles, Ints, Setting, Ticks

EVENTS: Final = 20_000
"""Moments of events that reactions are measured at."""
_SIDE: Final = 0.975
"""Confidence of each end of a two-sided 95 % interval."""


def chunk_row(
    cell: Cell, setting: Setting, cycles: Cycles, ticks: Ticks, *, epsilon: float, rng: np.random.Generator
) -> AboutCell:
    """Describe a cell's run; ``rng`` draws the moments of events, ``epsilon`` is the share that may stall."""
    latency_s = cell.drawn.judged / 1e9
    triggers = cell.triggers or ((cell.mode.trigger,) if hasattr(cell.mode, "trigger") else ())
    values = metrics_of(cell, setting, cycles, ticks, rng)
    values["slow_down"] = beta(cell.mode, cell.drawn.judged, setting, epsilon)
    row: AboutCell = ChunkRow(
        cell=cell.cell,
        mode=cell.name,
        rule=cell.rule,
        latency=cell.drawn.source.name,
        latency_s=float(latency_s.mean()),
        latency_s_p99=float(np.quantile(latency_s, 0.99)),
        rounding=setting.rounding,
        delta_t_s=setting.period_ns / 1e9,
        horizon=setting.horizon,
        execution_horizon=execution_horizon(cell.mode, setting),
        requests=int(latency_s.size),
        trigger=float(np.mean(triggers)) if triggers else None,
        **{name: _plain(values[name], whole=metric.whole) for name, metric in METRICS.items()},
    )
    return row


def metrics_of(
    cell: Cell, setting: Setting, cycles: Cycles, ticks: Ticks, rng: np.random.Generator
) -> dict[str, float | None]:
    """Return the value of every metric of what was simulated; NaN or None where there is none."""
    period_s, latency_ns = setting.period_ns / 1e9, cell.drawn.judged
    found: dict[str, Any] = asdict(measure(cell.mode, cycles, ticks))
    settled = cycles.settled
    boundaries, stalled = int(settled.sum()), int((cycles.stall_ticks[settled] > 0).sum())
    reaction_s = reactions_s(cycles, ticks, setting, rng)
    expected = closed(cell.mode, latency_ns, setting)
    mean_reaction = expected.mean_reaction_ticks
    delay = cycles.delay_ticks
    assumed = np.array(cell.triggers, np.float64) if cell.triggers else assumed_ticks(cell.mode)
    length = found["ticks"] or math.nan
    return found | {
        "stall_ticks_per_s": found["stall_ticks"] / length / period_s,
        "boundaries": boundaries,
        "stalled_cycles": stalled,
        "p_stall_low": 1 - upper_bound(boundaries - stalled, boundaries, _SIDE) if boundaries else None,
        "p_stall_high": upper_bound(stalled, boundaries, _SIDE) if boundaries else None,
        "p_stall_closed": expected.p_stall,
        "reaction_s_mean": float(reaction_s.mean()) if reaction_s.size else None,
        "reaction_s_p99": float(np.quantile(reaction_s, 0.99)) if reaction_s.size else None,
        "reaction_s_closed": None if mean_reaction is None else mean_reaction * period_s,
        "first_action_s": found["first_action_tick"] * period_s if found["age_ticks_mean"] >= 0 else None,
        "control_rate_hz": (found["ticks"] - found["stall_ticks"]) / length / period_s,
        "delay_ticks_mean": float(delay.mean()),
        "delay_ticks_p99": float(np.quantile(delay, 0.99)),
        "delay_ticks_max": float(delay.max()),
        "delay_assumed_ticks": None if assumed is None else float(np.mean(assumed)),
        "p_delay_above": None if assumed is None else float(np.mean(delay[1:] > _later(assumed))),
        "margin_ticks": margin_ticks(cell.mode, latency_ns, setting) if len(cell.triggers) < 2 else None,  # noqa: PLR2004 - the rule would answer
    }


def reactions_s(cycles: Cycles, ticks: Ticks, setting: Setting, rng: np.random.Generator) -> Floats:
    """Return the reaction times to events at uniform moments from the first action to the last request, in s."""
    acted = ticks.chunk >= 0
    if not acted.any():
        return np.empty(0)
    moments = rng.uniform(int(acted.argmax()), max(int(cycles.request_tick[-1]), int(acted.argmax())), EVENTS)
    found = reaction_ticks(cycles, moments) * (setting.period_ns / 1e9)
    return found[~np.isnan(found)]


def tick_rows(cell: str, ticks: Ticks, most: int) -> Iterator[TickRow]:
    """Yield the first ticks of a cell."""
    columns = (ticks.chunk, ticks.index, ticks.age, ticks.stalled)
    for tick, (chunk, index, age, stalled) in enumerate(zip(*(each[:most].tolist() for each in columns), strict=True)):
        none = chunk < 0
        yield TickRow(
            cell, tick, None if none else chunk, None if none else index, None if none else age, bool(stalled)
        )


def request_rows(cell: str, latency_ns: Ints, cycles: Cycles, most: int) -> Iterator[RequestRow]:
    """Yield the requests that left within the first ticks of a cell."""
    for request in range(int(np.searchsorted(cycles.request_tick, most))):
        executed = int(cycles.executed[request])
        yield RequestRow(
            cell=cell,
            request=request,
            request_tick=int(cycles.request_tick[request]),
            latency_ns=int(latency_ns[request]),
            delay_ticks=int(cycles.delay_ticks[request]),
            start_tick=int(cycles.start_tick[request]) if executed else None,
            first_index=int(cycles.first_index[request]) if executed else None,
            executed=executed,
            thrown_away=int(cycles.thrown_away[request]),
            stall_ticks=int(cycles.stall_ticks[request]),
            jump=int(cycles.jump[request]) if executed else None,
        )


def _later(assumed: Any) -> Any:
    """Return what was assumed of all requests but the first one."""
    return assumed[1:] if isinstance(assumed, np.ndarray) and assumed.size > 1 else assumed


def _plain(value: float | None, *, whole: bool) -> float | int | None:
    if value is None or math.isnan(value):
        return None
    return int(value) if whole else float(value)
