"""A simulated cell as rows: its metrics, its first ticks, its first requests."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.chunks.closed import assumed_ticks, beta, closed, execution_horizon
from s2a_bench.experiments.chunks.metrics import METRICS
from s2a_bench.experiments.chunks.rows import AboutCell, ChunkRow, ReactionRow, RequestRow, TickRow
from s2a_bench.policy.chunks.aggregate import Aggregate
from s2a_bench.policy.chunks.metrics import margin_ticks, measure, reaction_ticks
from s2a_bench.policy.conformal import upper_bound

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.cells import Cell
    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks import Cycles, Ints, Setting, Ticks

EVENTS: Final = 100_000
"""Moments of events that reactions are measured at."""
SHARES: Final = np.linspace(0, 1, 51)
"""Of the quantiles of reaction times that are kept."""
NO_NAMES: Final[Mapping[int, str]] = {}
_SIDE: Final = 0.975
"""Confidence of each end of a two-sided 95 % interval."""


def chunk_row(
    cell: Cell,
    setting: Setting,
    cycles: Cycles,
    ticks: Ticks,
    *,
    epsilon: float,
    reaction_s: Floats,
    smooth: Mapping[str, float],
) -> AboutCell:
    """Describe a cell's run.

    ``reaction_s`` are its reaction times, ``smooth`` its metrics of smoothness if any, and ``epsilon`` is the share
    that may stall.
    """
    latency_s = cell.drawn.judged / 1e9
    triggers = cell.triggers or ((cell.mode.trigger,) if hasattr(cell.mode, "trigger") else ())
    values = {**metrics_of(cell, setting, cycles, ticks, reaction_s), **smooth}
    values |= {"slow_down": beta(cell.mode, cell.drawn.judged, setting, epsilon), "slower": cell.slower}
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
        **{name: _plain(values.get(name), whole=metric.whole) for name, metric in METRICS.items()},
    )
    return row


def metrics_of(
    cell: Cell, setting: Setting, cycles: Cycles, ticks: Ticks, reaction_s: Floats
) -> dict[str, float | None]:
    """Return the value of every metric of what was simulated; NaN or None where there is none."""
    period_s, latency_ns = setting.period_ns / 1e9, cell.drawn.judged
    found: dict[str, Any] = asdict(measure(cell.mode, cycles, ticks))
    settled = cycles.settled
    boundaries, stalled = int(settled.sum()), int((cycles.stall_ticks[settled] > 0).sum())
    low, high = interval(stalled, boundaries)
    expected = closed(cell.mode, latency_ns, setting)
    mean_reaction = expected.mean_reaction_ticks
    delay = cycles.delay_ticks[: latency_ns.size]  # live, an answer may not have come by the end
    later = setting.rounding == "floor"  # an action leaves at the end of its tick
    assumed = np.array(cell.triggers, np.float64) if cell.triggers else assumed_ticks(cell.mode)
    length = found["ticks"] or math.nan
    return found | {
        "stall_ticks_per_s": found["stall_ticks"] / length / period_s,
        "boundaries": boundaries,
        "stalled_cycles": stalled,
        "p_stall_low": low,
        "p_stall_high": high,
        "p_stall_closed": expected.p_stall,
        "age_ticks_blended": _blended(cell, cycles),
        "reaction_s_mean": float(reaction_s.mean()) if reaction_s.size else None,
        "reaction_s_p99": float(np.quantile(reaction_s, 0.99)) if reaction_s.size else None,
        "reaction_s_closed": None if mean_reaction is None else mean_reaction * period_s,
        "first_action_s": (found["first_action_tick"] + later) * period_s if found["age_ticks_mean"] >= 0 else None,
        "control_rate_hz": (found["ticks"] - found["stall_ticks"]) / length / period_s,
        "delay_ticks_mean": float(delay.mean()),
        "delay_ticks_p99": float(np.quantile(delay, 0.99)),
        "delay_ticks_max": float(delay.max()),
        "delay_assumed_ticks": None if assumed is None else float(np.mean(assumed)),
        "p_delay_above": None if assumed is None else float(np.mean(delay[1:] > _later(assumed))),
        "margin_ticks": margin_ticks(cell.mode, latency_ns, setting) if len(cell.triggers) < 2 else None,  # noqa: PLR2004 - the rule would answer
    }


def interval(stalled: int, cycles: int) -> tuple[float | None, float | None]:
    """Return the two-sided 95 % interval of a share (Clopper and Pearson); None of nothing."""
    if not cycles:
        return None, None
    return 1 - upper_bound(cycles - stalled, cycles, _SIDE), upper_bound(stalled, cycles, _SIDE)


def reactions_s(cycles: Cycles, ticks: Ticks, setting: Setting, rng: np.random.Generator) -> Floats:
    """Return the reaction times to events at uniform moments from the first action to the last request, in s."""
    acted = ticks.chunk >= 0
    if not acted.any():
        return np.empty(0)
    moments = rng.uniform(int(acted.argmax()), max(int(cycles.request_tick[-1]), int(acted.argmax())), EVENTS)
    found = reaction_ticks(cycles, moments) * (setting.period_ns / 1e9)
    return found[~np.isnan(found)]


def reaction_rows(cell: Cell, latency_ns: Ints, setting: Setting, reaction_s: Floats) -> Iterator[ReactionRow]:
    """Yield the quantiles of a cell's reaction times, none where there are none."""
    if not reaction_s.size:
        return
    period_s = setting.period_ns / 1e9
    told = closed(cell.mode, latency_ns, setting).reaction_ticks(SHARES)
    found = np.quantile(reaction_s, SHARES).tolist()
    closed_s = [None] * SHARES.size if told is None else (told * period_s).tolist()
    for share, simulated_s, expected_s in zip(SHARES.tolist(), found, closed_s, strict=True):
        yield ReactionRow(cell.cell, share, simulated_s, expected_s)


def tick_rows(cell: str, ticks: Ticks, most: int, late_ns: Ints | None = None) -> Iterator[TickRow]:
    """Yield the first ticks of a cell; ``late_ns`` is how long after it was due each action left."""
    late = [None] * most if late_ns is None else late_ns.tolist()
    columns = (ticks.chunk, ticks.index, ticks.age, ticks.stalled)
    for tick, (chunk, index, age, stalled) in enumerate(zip(*(each[:most].tolist() for each in columns), strict=True)):
        none = chunk < 0
        yield TickRow(
            cell=cell,
            tick=tick,
            chunk=None if none else chunk,
            index=None if none else index,
            age_ticks=None if none else age,
            stalled=bool(stalled),
            late_ns=late[tick],
        )


def request_rows(
    cell: str, latency_ns: Ints, cycles: Cycles, most: int, names: Mapping[int, str] = NO_NAMES
) -> Iterator[RequestRow]:
    """Yield the requests that left within the first ticks of a cell; ``names`` are the ids of their samples."""
    for request in range(min(latency_ns.size, int(np.searchsorted(cycles.request_tick, most)))):
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
            request_id=names.get(request),
        )


def _blended(cell: Cell, cycles: Cycles) -> float | None:
    """Return the mean age behind blended actions, in ticks."""
    if not isinstance(cell.mode, Aggregate):
        return None
    age = cell.mode.blended_age(cycles)
    return float(np.nanmean(age)) if np.isfinite(age).any() else None


def _later(assumed: Any) -> Any:
    """Return what was assumed of all requests but the first one."""
    return assumed[1:] if isinstance(assumed, np.ndarray) and assumed.size > 1 else assumed


def _plain(value: float | None, *, whole: bool) -> float | int | None:
    if value is None or math.isnan(value):
        return None
    return int(value) if whole else float(value)
