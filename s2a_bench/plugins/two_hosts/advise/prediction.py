"""Predict each transport over a link: the fitted lines of a sweep of transports, plus the time that the link takes.

The sweep ran without a link, on one machine: its lines hold the work of both ends. The link adds its delays, and the
time in which its rate carries the bytes that the pipeline sends. Both are the median's; losses are not predicted.
TCP adds its pacing (BBR), or its slow start after idle (others); requests of other robots add a wait.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.experiments.latency.view.against_bytes import FittedPipeline, against_bytes
from s2a_bench.experiments.requests import cells_of
from s2a_bench.plugins.two_hosts.advise import MB, AdviseConfig
from s2a_bench.plugins.two_hosts.profiles import DELAY_OFF_MS, OFF, Direction, LinkProfile, bound_s, load_link
from s2a_bench.provenance import joined
from s2a_bench.stats.line import Line
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.store.sweep import is_sweep, read_sweep
from s2a_bench.transport import declared_transport
from s2a_bench.transport.pipeline import pipelines
from s2a_bench.writers.tables import ABSENT, TextTable, number

HEADERS: Final = 1500 / 1448
"""Bytes of IP packets for each byte of a body over TCP: Ethernet's 1,500 with time stamps."""
BBR_GAIN: Final = 2.89
"""The gain of BBR's start: its sending rate over the rate that it has seen (Cardwell et al., 2016), 2 / ln 2."""
PACKET_BYTES, INITIAL_WINDOW, RTO_MS = 1500, 10, 200.0
"""Linux: bytes and packets of the first window (RFC 6928), and the timeout over the round trip (`tcp_rto_min`)."""
MOST_HALVINGS: Final = 30
"""The most halvings of a window, after which it is the initial one."""
WAITS: Final = 0.05
"""Share of requests that wait longer than `Advice.wait_ms`."""
HALF: Final = 0.5
"""The share of the rate from which on a link without a deadline is *unclear*."""
PREDICTION: Final = (
    "End to end without inference: the sweep's line at this size of pictures, and the link. Intervals: 95 % (Student's "
    f"t) of a launch around the line, the {OFF:.0%} and {DELAY_OFF_MS} ms a way by which a link may be off, "
    "half of the jitter, and the least and most that this host's TCP adds."
)
WAIT: Final = (
    "Wait: in the queue behind other robots' requests, if all come at random (M/D/1); 95 % wait less. A deadline is "
    "met only with it. One robot that waits for its answers has none."
)
BOUND: Final = (
    "Bound: the link alone, with the bytes that the pipeline sends. Pictures are the sweep's: others are coded to more "
    "or fewer bytes."
)


@dataclass(frozen=True, slots=True)
class Advice:
    """The prediction of one pipeline, in ms; ``ends_ms`` is its 95 % interval, None for a line of two points."""

    pipeline: str
    payload: str
    e2e_ms: float
    ends_ms: tuple[float, float] | None
    link_ms: float
    coding_ms: float
    """Encoding and decoding, colours included."""
    bound_ms: float
    load: float
    """Share of the link's rate that the requests take."""
    wait_ms: float | None
    """The wait that 95 % of the requests stay below, if many robots share the rate; None: unbounded."""
    meets: bool | None
    """Whether it meets deadline and rate, in 95 % of requests; None if only perhaps."""
    measured_ms: float | None = None

    @property
    def name(self) -> str:
        return f"{self.pipeline}{'&' if '?' in self.pipeline else '?'}payload={self.payload}"

    @property
    def predicted(self) -> str:
        return number(self.e2e_ms) + (" [{}, {}]".format(*map(number, self.ends_ms)) if self.ends_ms else "")

    @property
    def limit(self) -> str:
        """Return the largest part: the link, coding, or the transport."""
        transport_ms = self.e2e_ms - self.link_ms - self.coding_ms
        parts = {"link": self.link_ms, "coding": self.coding_ms, "transport": transport_ms}
        return max(parts, key=lambda name: parts[name])

    @property
    def inside(self) -> bool | None:
        """Whether the measured value lies in the interval; None without either."""
        if self.measured_ms is None or self.ends_ms is None:
            return None
        return self.ends_ms[0] <= self.measured_ms <= self.ends_ms[1]


def advise(config: AdviseConfig) -> tuple[list[Advice], LinkProfile, str]:
    """Return a prediction for each pipeline of the sweep that crosses a network, the quickest first.

    Also the link, and the provenance of the sweep. Raises UsageError, StoreError.
    """
    profile = load_link(config.link)
    link = profile.directions()
    if any(each.steps for each in link):
        raise UsageError(f"`link`: {profile.name} changes with time; advice needs one rate, as rate=18/75,delay=25")
    lines, line = fitted(tuple(config.runs))
    advices = [_advice(each, each.line, profile, config) for each in lines if each.line]
    if not advices:
        raise UsageError("`runs`: no pipeline with pictures of two sizes or more; run s2a-bench sweep transports")
    origin = f"{line.removesuffix('.')}; PREDICTED for {profile.about}."
    return sorted(advices, key=lambda each: (each.load > 1, each.meets is False, each.e2e_ms)), profile, origin


def fitted(paths: Sequence[Path]) -> tuple[list[FittedPipeline], str]:
    """Return the pipelines of runs without a link that cross a network, and the runs' provenance."""
    runs = [run for path in paths for run in _runs(path) if not run.manifest["configuration"].get("link")]
    lines = [
        each
        for each in against_bytes([cells_of(run) for run in runs])
        if each.wire_share and not each.has_ingest and declared_transport(each.path[0]).crosses_links
    ]
    return lines, joined(run.origins for run in runs).line


def _runs(path: Path) -> list[StoredRun]:
    run = read_run(path)
    return [each for _, each in read_sweep(path).runs()] if is_sweep(run.manifest) else [run]


def _advice(pipeline: FittedPipeline, line: Line, profile: LinkProfile, config: AdviseConfig) -> Advice:
    up, down = link = profile.directions()
    size = (pipeline.wire_share or 0.0) * config.pixels_mb * MB
    jitter_ms = up.jitter_ms + down.jitter_ms  # a uniform share of it each way
    sent_ms = bound_s(link, size * HEADERS) * 1e3 - up.delay_ms - down.delay_ms
    cell = pipelines([pipeline.name])[0]
    udp = cell.transport.datagrams(cell.options)
    least_ms, most_ms = (0.0, 0.0) if udp else tcp_adds_ms(size, link, config.period_ms, host_tcp())
    link_ms = sent_ms + up.usual_ms + down.usual_ms + (least_ms + most_ms) / 2
    work_ms = line.at(config.pixels_mb)
    reach_ms = line.reach(config.pixels_mb)
    e2e_ms = work_ms + link_ms
    off_ms = 2 * DELAY_OFF_MS + OFF * link_ms + (jitter_ms + most_ms - least_ms) / 2
    ends_ms = None if reach_ms is None else (max(0.0, e2e_ms - reach_ms - off_ms), e2e_ms + reach_ms + off_ms)
    load = size * HEADERS * 8e-6 * config.rate / up.mbps
    wait_ms = waiting_ms(load, load * config.period_ms)
    low, high = ends_ms or (e2e_ms, e2e_ms)
    surely = load < HALF if math.isinf(config.deadline_ms) else high + (wait_ms or 0.0) <= config.deadline_ms
    meets = True if surely and wait_ms is not None else None
    if load > 1 or low > config.deadline_ms:
        meets = False
    coding_ms = 0.0 if pipeline.coding is None else pipeline.coding.at(config.pixels_mb)
    bound_ms = bound_s(link, size) * 1e3
    return Advice(pipeline.name, pipeline.payload, e2e_ms, ends_ms, link_ms, coding_ms, bound_ms, load, wait_ms, meets)


@dataclass(frozen=True, slots=True)
class Tcp:
    """A host's TCP, as Linux's settings ``net.ipv4.tcp_*`` name it."""

    congestion_control: str
    slow_start_after_idle: bool

    def __str__(self) -> str:
        idle = f", slow start after idle {'on' if self.slow_start_after_idle else 'off'}"
        return self.congestion_control + idle * (self.congestion_control != "bbr")


def host_tcp() -> Tcp:
    """Return this host's TCP; Linux's usual one where there are no settings."""
    net = Path("/proc/sys/net/ipv4")
    try:
        name, slow = ((net / f"tcp_{key}").read_text().strip() for key in Tcp.__slots__)
    except OSError:
        return Tcp("cubic", slow_start_after_idle=True)
    return Tcp(name, slow == "1")


def tcp_adds_ms(size: float, link: tuple[Direction, Direction], period_ms: float, tcp: Tcp) -> tuple[float, float]:
    """Return the least and the most that TCP adds to the time of a body which is sent each ``period_ms``.

    BBR paces a body at `BBR_GAIN` times the rate that it has seen, and has seen one body a round trip. So a body takes
    t = (RTT + t) / `BBR_GAIN`, whatever its size, if the link is faster than that; half of that either way.

    Other TCP halves its window for each timeout of idle, down to `INITIAL_WINDOW` (Linux's tcp_cwnd_restart), and then
    doubles it each round trip, in which it waits while the link takes less than that for the window. The most: the
    window held the body, or what the link holds, and the idle time is the whole period. The least: the window had
    grown by the body, and what is added shortens the idle time.
    """
    up, down = link
    round_ms = up.delay_ms + down.delay_ms
    sent_ms = (up.least_s(size * HEADERS) - up.least_s(0)) * 1e3
    if tcp.congestion_control == "bbr":
        paced_ms = max(0.0, round_ms / (BBR_GAIN - 1) - sent_ms)
        return paced_ms / 2, paced_ms * 1.5
    packets = math.ceil(size * HEADERS / PACKET_BYTES)
    held = int(min(packets, round_ms * up.mbps * 125 / PACKET_BYTES))

    def added_ms(window: int) -> float:
        left, total_ms, window = packets, 0.0, max(INITIAL_WINDOW, window)
        while left > window and (waits_ms := round_ms - (up.least_s(window * PACKET_BYTES) - up.least_s(0)) * 1e3) > 0:
            left, window, total_ms = left - window, 2 * window, total_ms + waits_ms
        return total_ms

    def halvings(idle_ms: float) -> int:
        return min(MOST_HALVINGS, math.ceil(idle_ms / (round_ms + RTO_MS)) - 1)

    most = halvings(period_ms - sent_ms) if tcp.slow_start_after_idle else 0
    grown_ms = ((count, added_ms(math.ceil(packets / (2**count - 1)))) for count in range(most, 0, -1))
    least_ms = next((ms for count, ms in grown_ms if halvings(period_ms - sent_ms - ms) >= count), 0.0)
    return least_ms, added_ms(held >> most) if most > 0 else 0.0


def waiting_ms(load: float, service_ms: float) -> float | None:
    """Return what all but `WAITS` of random (Poisson) requests wait less than, for a link so loaded; None: no limit.

    For equal requests (M/D/1), below one service time: P(wait > t) = 1 - (1 - load) exp(load t / service). Above it,
    Kingman's bound (1964): P(wait > t) <= exp(-x t / service), with load (exp(x) - 1) = x.
    """
    from scipy.special import lambertw

    if load >= 1:
        return None
    exact = math.log((1 - WAITS) / (1 - load)) / load if load > WAITS else 0.0  # most find the link free
    if exact <= 1:
        return exact * service_ms
    decay = -load - float(lambertw(-load * math.exp(-load), -1).real)
    return -math.log(WAITS) / decay * service_ms


def advice_table(advices: Sequence[Advice], config: AdviseConfig, profile: LinkProfile, provenance: str) -> TextTable:
    columns = {
        "pipeline": [each.pipeline for each in advices],
        "payload": [each.payload for each in advices],
        "predicted ms": [each.predicted for each in advices],
    }
    if any(each.measured_ms is not None for each in advices):
        columns["measured ms"] = [_measured(each) for each in advices]
    columns |= {"bound ms": [number(each.bound_ms) for each in advices], "limited by": [each.limit for each in advices]}
    if config.rate:
        columns["of the rate"] = [f"{each.load:.0%}" for each in advices]
        columns["wait ms"] = [number(each.wait_ms) for each in advices]
    if config.deadline or config.rate:
        columns["meets it"] = [{True: "yes", False: "no", None: "unclear"}[each.meets] for each in advices]
    notes = (
        PREDICTION,
        f"TCP: {host_tcp()}, as this host's; requests {_pause(config)}.",
        *([WAIT] if config.rate else []),
        BOUND,
        *(["Losses are not predicted: the times hold for requests without one."] if profile.loss else []),
    )
    title = f"{config.cameras} x {config.size[0]}x{config.size[1]} over {profile.about}, predicted"
    rows = [*zip(*columns.values(), strict=True)]
    return TextTable(title, tuple(columns), rows, 2, notes=notes, provenance=provenance)


def _pause(config: AdviseConfig) -> str:
    return f"come every {config.period_ms:g} ms" if config.rate else "follow one another without a pause"


def _measured(advice: Advice) -> str:
    if advice.measured_ms is None:
        return ABSENT
    return number(advice.measured_ms) + {True: ", inside", False: ", outside", None: ""}[advice.inside]


def sentence(advices: Sequence[Advice], config: AdviseConfig, profile: LinkProfile) -> str:
    best = advices[0]
    if best.load > 1:
        return f"{profile.name} carries {config.rate:g} such requests a second over no transport of the sweep."
    text = f"{best.pipeline} with {best.payload} is the quickest over {profile.name}: {best.predicted} ms"
    if config.deadline:
        meet = sum(each.meets is True for each in advices)
        text += f"; {meet} of {len(advices)} surely meet {config.deadline_ms:g} ms"
    return f"{text}; the {best.limit} takes the most of it, if TCP is {host_tcp()} and requests {_pause(config)}."


def advice_json(
    advices: Sequence[Advice], config: AdviseConfig, profile: LinkProfile, provenance: str
) -> dict[str, Any]:
    return {
        "schema": "s2a-bench-advise/1",
        "command": "advise",
        "link": profile.model_dump(mode="json", exclude_defaults=True),
        "provenance": provenance,
        "tcp": asdict(host_tcp()),
        "cells": [{**asdict(each), "limit": each.limit, "inside": each.inside} for each in advices],
        "sentence": sentence(advices, config, profile),
    }
