"""The rows of a cell (metrics, first ticks, first requests), of varied triggers, and of varied mean latencies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from s2a_bench.experiments.cells import COUNT
from s2a_bench.plugins.chunks.chunks.cells import ActingCell, LatencyDraw, without_trigger
from s2a_bench.plugins.chunks.chunks.rows import (
    CHUNKS,
    METRICS,
    REACTIONS,
    REQUESTS,
    TICKS,
    ChunkRow,
    MeanRow,
    ReactionRow,
    RequestRow,
    TickRow,
    TriggerRow,
)
from s2a_bench.plugins.chunks.modes import ControlSetting, Cycles, Ints, Mode, Ticks
from s2a_bench.plugins.chunks.modes.closed import beta, closed
from s2a_bench.plugins.chunks.modes.metrics import greatest, margin_ticks, mean, measure, p99, reaction_ticks
from s2a_bench.plugins.chunks.options import ControlPlan
from s2a_bench.policy import Floats
from s2a_bench.policy.conformal import interval
from s2a_bench.stats.seeds import generator
from s2a_bench.store.schema import Table

EVENTS: Final = 100_000
"""Random events whose reaction times are measured."""
MOST_POINTS: Final = 64
"""Triggers that are tried."""
MEANS_TRIED: Final = 33
REQUESTS_TRIED: Final = 2000
"""The number of simulated requests at each mean."""
SHARES: Final = np.linspace(0, 1, 401)
"""Quantiles of reaction times that are stored: denser than a figure can show."""


@dataclass(frozen=True, slots=True, eq=False)
class ActedCell:
    """The cycles and the ticks of a cell."""

    cell: ActingCell
    setting: ControlSetting
    """The setting, with actions as slow as the cell's."""
    cycles: Cycles
    ticks: Ticks
    more: Mapping[str, Any] = field(default_factory=dict)
    """Metrics that are measured, or override computed ones."""
    late_ns: Ints | None = None
    """Delay of each action after its due time; None in virtual time."""
    names: Mapping[int, str] = field(default_factory=dict)
    """Request -> the id of its sample."""

    @property
    def latency_ns(self) -> Ints:
        return self.cell.latencies.judged


def cell_rows(acted: ActedCell, shown: int, epsilon: float, seed: int) -> dict[Table[Any], Iterable[Any]]:
    """Return the rows of a cell by their table; ticks and requests are those within the first ``shown`` ticks."""
    cell, setting, latency_ns = acted.cell, acted.setting, acted.latency_ns
    reaction_s = reactions_s(acted.cycles, acted.ticks, setting, generator(seed, "chunks events"))
    values = metrics_of(acted, reaction_s)
    values |= {"slow_down": beta(cell.mode, latency_ns, setting, epsilon), "slower": cell.slower, **acted.more}
    row = ChunkRow(
        cell=cell.cell,
        mode=cell.name,
        rule=cell.rule,
        latency=cell.latencies.source.name,
        latency_s=float((latency_ns / 1e9).mean()),
        latency_s_p99=float(np.quantile(latency_ns / 1e9, 0.99)),
        rounding=setting.rounding,
        delta_t_s=setting.period_ns / 1e9,
        horizon=setting.horizon,
        execution_horizon=cell.mode.execution_horizon(setting),
        requests=int(latency_ns.size),
        trigger=_mean(cell.triggers, cell.mode.trigger),
        **_plain(values),
    )
    return {
        CHUNKS: [row],
        REACTIONS: _reaction_rows(acted, reaction_s),
        TICKS: _tick_rows(acted, shown),
        REQUESTS: _request_rows(acted, shown),
    }


def metrics_of(acted: ActedCell, reaction_s: Floats) -> dict[str, float | None]:
    """Return the value of every computed metric; NaN or None if it has none."""
    cell, setting, cycles, latency_ns = acted.cell, acted.setting, acted.cycles, acted.latency_ns
    period_s = setting.period_ns / 1e9
    measured: dict[str, Any] = asdict(measure(cell.mode, cycles, acted.ticks))
    expected = closed(cell.acting, latency_ns, setting)
    mean_reaction = expected.mean_reaction_ticks
    delay = cycles.delay_ticks[: latency_ns.size]  # a live run may end before an answer
    later = setting.rounding == "floor"  # an action leaves at the end of its tick
    assumed = np.array(cell.triggers[1:] or cell.triggers) if cell.triggers else cell.mode.assumed_ticks
    length = measured["ticks"] or math.nan
    return measured | {
        **stalls_of(cycles),
        "stall_ticks_per_s": measured["stall_ticks"] / length / period_s,
        "p_stall_closed": expected.p_stall,
        "age_ticks_blended": _blended(cell, cycles),
        "reaction_s_mean": mean(reaction_s),
        "reaction_s_p99": p99(reaction_s),
        "reaction_s_closed": None if mean_reaction is None else mean_reaction * period_s,
        "first_action_s": (measured["first_action_tick"] + later) * period_s
        if measured["age_ticks_mean"] >= 0
        else None,
        "control_rate_hz": (measured["ticks"] - measured["stall_ticks"]) / length / period_s,
        "delay_ticks_mean": mean(delay),
        "delay_ticks_p99": p99(delay),
        "delay_ticks_max": greatest(delay),
        "delay_assumed_ticks": _mean(cell.triggers, cell.mode.assumed_ticks),
        "p_delay_above": None if assumed is None else float(np.mean(delay[1:] > assumed)),
        "margin_ticks": margin_ticks(cell.acting, latency_ns, setting) if len(cell.triggers) < 2 else None,  # noqa: PLR2004 - the rule would answer
    }


def stalls_of(cycles: Cycles) -> dict[str, Any]:
    return stall_metrics(int((cycles.stall_ticks[cycles.settled] > 0).sum()), int(cycles.settled.sum()))


def stall_metrics(stalled: int, boundaries: int) -> dict[str, Any]:
    """Return counts, and with boundaries the share and its two-sided 95 % interval (Clopper and Pearson)."""
    counts: dict[str, Any] = {"boundaries": boundaries, "stalled_cycles": stalled}
    if boundaries:
        counts["p_stall_cycle"] = stalled / boundaries
        counts["p_stall_low"], counts["p_stall_high"] = interval(stalled, boundaries)
    return counts


def reactions_s(cycles: Cycles, ticks: Ticks, setting: ControlSetting, rng: np.random.Generator) -> Floats:
    """Return the reaction times in s to uniform random events from the first action to the last request."""
    acted = ticks.chunk >= 0
    if not acted.any():
        return np.empty(0)
    moments = rng.uniform(int(acted.argmax()), max(int(cycles.request_tick[-1]), int(acted.argmax())), EVENTS)
    after_s = reaction_ticks(cycles, moments) * (setting.period_ns / 1e9)
    return after_s[~np.isnan(after_s)]


def _reaction_rows(acted: ActedCell, reaction_s: Floats) -> Iterator[ReactionRow]:
    if not reaction_s.size:
        return
    cell, period_s = acted.cell, acted.setting.period_ns / 1e9
    form = closed(cell.acting, acted.latency_ns, acted.setting).reaction_ticks(SHARES)
    quantiles_s = np.quantile(reaction_s, SHARES).tolist()
    closed_s = [None] * SHARES.size if form is None else (form * period_s).tolist()
    for share, simulated_s, expected_s in zip(SHARES.tolist(), quantiles_s, closed_s, strict=True):
        yield ReactionRow(cell.cell, share, simulated_s, expected_s)


def _tick_rows(acted: ActedCell, shown: int) -> Iterator[TickRow]:
    ticks = acted.ticks
    late = [None] * ticks.chunk.size if acted.late_ns is None else acted.late_ns.tolist()
    columns = (each[:shown].tolist() for each in (ticks.chunk, ticks.index, ticks.age, ticks.stalled))
    for tick, (*action, stalled, late_ns) in enumerate(zip(*columns, late[:shown], strict=True)):
        chunk, index, age = action if action[0] >= 0 else (None, None, None)
        yield TickRow(acted.cell.cell, tick, chunk, index, age, stalled, late_ns)


def _request_rows(acted: ActedCell, shown: int) -> Iterator[RequestRow]:
    cycles, latency_ns = acted.cycles, acted.latency_ns
    delay_ticks, thrown_away = cycles.delay_ticks, cycles.thrown_away
    for request in range(min(latency_ns.size, int(np.searchsorted(cycles.request_tick, shown)))):
        executed = int(cycles.executed[request])
        yield RequestRow(
            cell=acted.cell.cell,
            request=request,
            request_tick=int(cycles.request_tick[request]),
            latency_ns=int(latency_ns[request]),
            delay_ticks=int(delay_ticks[request]),
            start_tick=int(cycles.start_tick[request]) if executed else None,
            first_index=int(cycles.first_index[request]) if executed else None,
            executed=executed,
            thrown_away=int(thrown_away[request]),
            stall_ticks=int(cycles.stall_ticks[request]),
            jump=int(cycles.jump[request]) if executed else None,
            request_id=acted.names.get(request),
        )


def _mean(triggers: tuple[int, ...], trigger: int | None) -> float | None:
    if triggers:
        return float(np.mean(triggers))
    return None if trigger is None else float(trigger)


def _blended(cell: ActingCell, cycles: Cycles) -> float | None:
    age = cell.mode.blended_age(cycles)
    return None if age is None or not np.isfinite(age).any() else float(np.nanmean(age))


def _plain(values: Mapping[str, float | None]) -> dict[str, Any]:
    """Return the value of every metric as its column has it, None for NaN."""
    plain: dict[str, Any] = dict.fromkeys(METRICS)
    for name, metric in METRICS.items():
        value = values.get(name)
        if value is not None and not math.isnan(value):
            plain[name] = int(value) if metric.kind == COUNT else float(value)
    return plain


def trigger_rows(mode: Mode, setting: ControlSetting, latencies: LatencyDraw) -> Iterator[TriggerRow]:
    length = mode.execution_horizon(setting)
    for ticks in np.unique(np.linspace(0, length - 1, min(length, MOST_POINTS)).round()).astype(int).tolist():
        tried = mode.varied((ticks,))
        cycles = tried.cycles(latencies.judged, setting)
        counts = stalls_of(cycles)
        del counts["stalled_cycles"]
        if counts["boundaries"]:
            yield TriggerRow(
                latency=latencies.source.name,
                mode=without_trigger(mode),
                execution_horizon=length,
                trigger=ticks,
                **counts,
                p_stall_closed=closed(tried, latencies.judged, setting).p_stall,
                age_ticks_mean=mean_age(cycles),
            )


def mean_rows(control: ControlPlan, latencies: LatencyDraw) -> Iterator[MeanRow]:
    """Yield a row for each mode under the source's latencies scaled to means from 0 to H ticks."""
    setting, judged = control.setting, latencies.judged[:REQUESTS_TRIED]
    shape = judged / max(float(judged.mean()), 1.0)
    for mean_ns in np.linspace(0, setting.horizon * setting.period_ns, MEANS_TRIED):
        latency_ns = np.rint(shape * mean_ns).astype(np.int64)
        for name, mode in control.modes.items():
            cycles, ticks = mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting)
            share = measure(mode, cycles, ticks).stall_share
            yield MeanRow(
                latency=latencies.source.name,
                mode=name,
                latency_s=mean_ns / 1e9,
                stall_share=None if np.isnan(share) else share,
            )


def mean_age(cycles: Cycles) -> float:
    """Return the mean age of the observation in ticks over executed actions; each chunk is executed in one run."""
    middle = cycles.start_tick - cycles.request_tick + (cycles.executed - 1) / 2
    return float(np.average(middle, weights=cycles.executed))
