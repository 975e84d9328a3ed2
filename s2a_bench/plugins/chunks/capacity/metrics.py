"""What a robot of a fleet does, measured or simulated, and the metrics of a fleet: one function for both."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.experiments.cells import Metric, mean, metrics_of, share
from s2a_bench.plugins.chunks.modes import ControlSetting, Flags, Ints, Ticks

BLOCKS: Final = 5
"""Of time, between which stalls vary; long against the queue's memory."""
UNSEEN: Final = 2.5
"""Of the largest event, the size of one that was not seen."""
LEAST: Final = 1 / 16
"""Of a cycle of all robots, the least size of an event that was not seen: one tick of each chunk of 16."""


@dataclass(frozen=True, kw_only=True)
class FleetMetrics:
    """The metrics of a fleet, or of one robot of it."""

    requests_per_s: Annotated[
        float | None, mean("req/s", "Complete answers a second, of all robots.", unit="1/s", better="higher")
    ]
    latency_mean_ns: Annotated[
        int | None, Metric("latency", "From the intended time of a request to its complete answer, the mean.")
    ]
    latency_p50_ns: Annotated[int | None, Metric("p50", "Its median.")]
    latency_p99_ns: Annotated[int | None, Metric("p99", "Its 99th percentile.")]
    ttft_p50_ns: Annotated[
        int | None, Metric("TTFT p50", "From the intended time of a request to the first piece of its answer.")
    ]
    ttft_p99_ns: Annotated[int | None, Metric("TTFT p99", "Its 99th percentile.")]
    in_time: Annotated[
        float | None,
        share("in time, %", "Share of the answers that came before the robot had to wait.", better="higher"),
    ]
    stalled: Annotated[
        float | None, share("stalled, %", "Share of the due ticks without an action; of the plans, those that stall.")
    ]
    stalled_low: Annotated[float | None, share("from", "Its interval, over robots and blocks of time; the lower end.")]
    stalled_high: Annotated[float | None, share("to", "The upper end.")]
    stalled_alone: Annotated[float | None, share("alone", "The share of one robot alone.", better="neither")]
    stalled_worst: Annotated[float | None, share("worst", "The greatest share of a robot.")]
    age_p50_ns: Annotated[int | None, Metric("age p50", "Of the observation behind an executed action, the median.")]
    age_p99_ns: Annotated[int | None, Metric("p99", "Its 99th percentile.")]
    unfair: Annotated[float | None, mean("worst/mean", "The greatest mean latency of a robot over that of all.")]
    late_p99_ns: Annotated[
        int | None, Metric("late", "Measured: lateness of the generator's own ticks, 99th percentile.")
    ]
    generator_cpu: Annotated[
        float | None, mean("generator", "Measured: CPU time of the generator a second.", unit="cores", better="neither")
    ]
    server_cpu: Annotated[
        float | None, mean("server", "Measured: CPU time of the server a second.", unit="cores", better="neither")
    ]
    gpu: Annotated[float | None, share("GPU, %", "Measured: utilisation.", better="neither")]
    watts: Annotated[float | None, mean("W", "Measured: power.", unit="W", better="neither")]


METRICS: Final = metrics_of(FleetMetrics)


@dataclass(frozen=True, slots=True, eq=False)
class RobotTrace:
    """What one robot requested and executed from ``start_ns`` to ``end_ns``, times on the run's clock.

    With episodes a robot has a trace for each of them. A robot without a clock (closed loop) has no ``ticks``.
    """

    robot: int
    start_ns: int
    """When its first tick began; without a clock, when it started."""
    end_ns: int
    request_ns: Ints
    """Intended time of each request, the tick in which its mode wanted it: shape (R,)."""
    arrival_ns: Ints
    """Complete answer after the intended time: shape (R,), -1 for none."""
    ticks: Ticks | None = None
    first_ns: Ints | None = None
    """First piece of the answer after the intended time, where it streams: shape (R,), -1 for none."""
    late_ns: Ints | None = None
    """Lateness of each tick, or of each request without a clock, -1 where it was not made; None in virtual time."""
    plan_stalled: Flags | None = None
    """Whether each plan stalls: shape (R,)."""

    def shifted(self, by_ns: int) -> RobotTrace:
        start_ns, end_ns, request_ns = self.start_ns + by_ns, self.end_ns + by_ns, self.request_ns + by_ns
        return replace(self, start_ns=start_ns, end_ns=end_ns, request_ns=request_ns)


def measures(
    traces: Sequence[RobotTrace], setting: ControlSetting, settle_ns: int = 0, *, confidence: float = 0.95
) -> FleetMetrics:
    """Return the metrics of a fleet; each trace counts from ``settle_ns`` after its start.

    Every due tick without an action is stalled, before the first action too: a robot without an answer stands still.
    """
    robots = _joined(np.full(trace.request_ns.size, trace.robot) for trace in traces)
    counts = _joined(trace.request_ns - trace.start_ns >= settle_ns for trace in traces)
    latency_ns = _joined(trace.arrival_ns for trace in traces)
    answered = counts & (latency_ns >= 0)
    of_robot = np.bincount(robots[answered])
    means = np.bincount(robots[answered], latency_ns[answered])[of_robot > 0] / of_robot[of_robot > 0]
    first_ns = _joined(np.full_like(each.arrival_ns, -1) if each.first_ns is None else each.first_ns for each in traces)
    skipped = -(-settle_ns // setting.period_ns)
    late_ns = _joined(
        trace.late_ns[skipped:]
        if trace.ticks is not None
        else trace.late_ns[trace.request_ns - trace.start_ns >= settle_ns]
        for trace in traces
        if trace.late_ns is not None
    )
    age = _joined(trace.ticks.age[skipped:] for trace in traces if trace.ticks is not None)
    values: dict[str, float | None] = {
        "requests_per_s": _rate(traces, settle_ns),
        "latency_mean_ns": _mean(latency_ns[answered]),
        **_quantiles("latency", latency_ns[answered]),
        **_quantiles("ttft", first_ns[counts & (first_ns >= 0)]),
        "in_time": _mean(_joined(_in_time(trace.ticks, skipped) for trace in traces)),
        **_quantiles("age", age[age >= 0] * setting.period_ns),
        **_stalls(traces, setting, settle_ns, confidence),
        "unfair": float(means.max() / latency_ns[answered].mean()) if means.any() else None,
        **_quantiles("late", late_ns[late_ns >= 0]),
    }
    columns: dict[str, Any] = {metric.column: values.get(metric.column) for metric in METRICS.values()}
    whole = {column: round(value) for column, value in columns.items() if column.endswith("_ns") and value is not None}
    return FleetMetrics(**columns | whole)


def _rate(traces: Sequence[RobotTrace], settle_ns: int) -> float | None:
    """Return the answers a second while all robots act; counted from each one's own start, cycles would line up."""
    episodes: defaultdict[int, list[RobotTrace]] = defaultdict(list)
    robots: Counter[int] = Counter()
    for trace in traces:
        episodes[robots[trace.robot]].append(trace)
        robots[trace.robot] += 1
    done = spent_ns = 0
    for episode in episodes.values():
        start_ns, end_ns = max(trace.start_ns for trace in episode) + settle_ns, min(trace.end_ns for trace in episode)
        at_ns = _joined((trace.request_ns + trace.arrival_ns)[trace.arrival_ns >= 0] for trace in episode)
        done += int(np.count_nonzero((at_ns >= start_ns) & (at_ns < end_ns)))
        spent_ns += max(0, end_ns - start_ns)
    return done / spent_ns * 1e9 if spent_ns else None


def _stalls(
    traces: Sequence[RobotTrace], setting: ControlSetting, settle_ns: int, confidence: float
) -> dict[str, float]:
    """Return the stalled share, its interval and that of the worst robot, of ticks or of plans; empty without any."""

    def stalls_of(trace: RobotTrace) -> tuple[Ints, Flags] | None:
        if trace.plan_stalled is not None:
            return trace.request_ns - trace.start_ns, trace.plan_stalled
        if trace.ticks is None:
            return None
        return np.arange(trace.ticks.chunk.size) * setting.period_ns, trace.ticks.chunk < 0

    at_ns, robots, stalled = flagged(traces, settle_ns, stalls_of)
    if not stalled.size:
        return {}
    low, high = share_interval(stalled, at_ns, robots, cycle_ns(traces), confidence)
    due = np.bincount(robots)
    worst = (np.bincount(robots, stalled)[due > 0] / due[due > 0]).max()
    return {"stalled": float(stalled.mean()), "stalled_low": low, "stalled_high": high, "stalled_worst": float(worst)}


def flagged(
    traces: Sequence[RobotTrace], settle_ns: int, flags_of: Callable[[RobotTrace], tuple[Ints, Flags] | None]
) -> tuple[Ints, Ints, Flags]:
    """Return time, robot and flag of the settled values of all traces, shapes (K,).

    ``flags_of`` returns those of a trace: times after its start, and flags; None without any.
    """
    parts = []
    for trace in traces:
        if (values := flags_of(trace)) is not None:
            since_ns, flags = values
            settled = since_ns >= settle_ns
            robots = np.full(np.count_nonzero(settled), trace.robot)
            parts.append((trace.start_ns + since_ns[settled], robots, flags[settled]))
    at_ns, of_robot, every = map(_joined, zip(*parts, strict=True) if parts else ((), (), ()))
    return at_ns, of_robot, every


def cycle_ns(traces: Sequence[RobotTrace]) -> float:
    """Return the mean time between two requests of a robot."""
    return sum(each.end_ns - each.start_ns for each in traces) / max(1, sum(each.request_ns.size for each in traces))


def share_interval(
    stalled: Flags, at_ns: Ints, robots: Ints, cycle_ns: float, confidence: float = 0.95
) -> tuple[float, float]:
    """Return the interval of the share of true values, with their times and robots: shapes (K,), K > 0.

    Stalls come in events, as robots wait for one server: those within ``cycle_ns``, the time between two requests of a
    robot, are one. So their number is a sum of few events of unlike size, which has the interval of Fay and Feuer
    (Statistics in Medicine 16, 1997). Its variance is that between `BLOCKS` of time, or between robots where that is
    greater, and has as many degrees of freedom as there are blocks, or events of equal size where these are fewer, less
    one. One more event is taken to be possible, of `UNSEEN` times the largest, or `LEAST` of a cycle. Above a half, it
    is the interval of the false values. How often it holds the truth: ``benchmarks/capacity_coverage.py``.
    """
    from scipy import stats

    if stalled.mean() > 0.5:  # noqa: PLR2004
        low, high = share_interval(~stalled, at_ns, robots, cycle_ns, confidence)
        return 1 - high, 1 - low
    events = _events(at_ns[stalled], cycle_ns)
    hits, squares = float(events.sum()), float(events @ events)
    span_ns, side = np.ptp(at_ns) + 1, (1 + confidence) / 2
    variance = squares
    groupings = ((at_ns - at_ns.min()) * BLOCKS // span_ns, robots)
    variances = [_variance(stalled, labels) for labels in groupings if np.unique(labels).size >= BLOCKS]
    if variances and hits:
        variance, groups = max(variances)
        freedom = max(1.0, min(groups, hits**2 / squares) - 1)
        variance *= float(stats.t.ppf(side, freedom) / stats.norm.ppf(side)) ** 2
    low = float(stats.gamma.ppf(1 - side, hits**2 / variance, scale=variance / hits)) if variance else hits
    unseen = UNSEEN * max(events.max(initial=1), LEAST * cycle_ns / span_ns * stalled.size)
    hits, variance = hits + unseen, variance + unseen**2
    high = float(stats.gamma.ppf(side, hits**2 / variance, scale=variance / hits))
    return low / stalled.size, min(1.0, high / stalled.size)


def _events(at_ns: Ints, cycle_ns: float) -> NDArray[np.float64]:
    """Return the sizes of events: values within a cycle of the first of them."""
    at_ns, places = np.sort(at_ns), [0]
    while places[-1] < at_ns.size:
        places.append(int(np.searchsorted(at_ns, at_ns[places[-1]] + cycle_ns)))
    return np.diff(places).astype(np.float64)


def _variance(stalled: Flags, labels: Ints) -> tuple[float, int]:
    """Return the variance of the number of true values by that between groups, and the number of groups."""
    size = np.bincount(labels)
    groups = int((size > 0).sum())
    off = np.bincount(labels, stalled) - stalled.mean() * size
    return float(groups / (groups - 1) * (off @ off)), groups


def _in_time(ticks: Ticks | None, skipped: int) -> Flags:
    """Return for each chunk but the first whether it took over without a stall."""
    acted = np.flatnonzero(ticks.chunk >= 0) if ticks is not None else np.empty(0, np.int64)
    if ticks is None or acted.size == 0:
        return acted > 0
    later = np.flatnonzero(np.diff(ticks.chunk[acted])) + 1
    without_stall: Flags = np.diff(acted)[later - 1] == 1
    return without_stall[acted[later] >= skipped]


def _joined(parts: Iterable[NDArray[Any]]) -> NDArray[Any]:
    arrays = list(parts)
    return np.concatenate(arrays) if arrays else np.empty(0, np.int64)


def _quantiles(name: str, values_ns: NDArray[Any]) -> dict[str, float]:
    if not values_ns.size:
        return {}
    p50, p99 = np.quantile(values_ns, (0.5, 0.99)).tolist()
    return {f"{name}_p50_ns": p50, f"{name}_p99_ns": p99}


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if values.size else None
