"""Which transport for a link: the fitted lines of a sweep of transports, plus what the link takes.

The sweep ran without a link, on one machine: its lines hold the work of both ends. The link adds its delays, and the
time in which its rate carries the bytes that the pipeline sends. Both are the median's; losses are not predicted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from s2a_bench.boards.links import Direction, LinkProfile, bound_s, load_link
from s2a_bench.errors import UsageError
from s2a_bench.experiments.latency.view.against_bytes import FittedPipeline, against_bytes
from s2a_bench.experiments.requests import split
from s2a_bench.provenance import joined
from s2a_bench.report.advise import MB, AdviseConfig
from s2a_bench.stats.line import Line
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.store.sweep import is_sweep, read_sweep
from s2a_bench.transport import declared_transport
from s2a_bench.transport.pipeline import pipelines
from s2a_bench.writers.tables import ABSENT, TextTable, number

HEADERS: Final = 1500 / 1448
"""Bytes of IP packets for each byte of a body over TCP: Ethernet's 1,500 with time stamps."""
BBR_GAIN: Final = 2.89
"""Of the rate at which BBR's start sends, over the rate that it has seen (Cardwell et al., 2016): 2 / ln 2."""
RATE_OFF, DELAY_OFF_MS = 0.05, 0.3
"""By how much a link may be off its profile: a share of its rate, and in one direction."""
PREDICTION: Final = (
    "End to end without inference: the sweep's line at this size of pictures, and the link. Intervals: 95 % (Student's "
    "t) of a launch around the line, the 5 % and 0.3 ms a way by which a link may be off its profile, and half of what "
    "jitter and the pacing of this host's TCP (BBR) add."
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
    meets: bool | None
    """Whether it meets the deadline; None if the interval has it inside."""
    measured_ms: float | None = None

    @property
    def name(self) -> str:
        return f"{self.pipeline}{'&' if '?' in self.pipeline else '?'}payload={self.payload}"

    @property
    def limit(self) -> str:
        """What takes the most: the link, coding, or the transport."""
        transport_ms = self.e2e_ms - self.link_ms - self.coding_ms
        parts = {"link": self.link_ms, "coding": self.coding_ms, "transport": transport_ms}
        return max(parts, key=lambda name: parts[name])

    @property
    def inside(self) -> bool | None:
        """Whether what was measured lies in the interval; None without either."""
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
    found = [_advice(each, each.line, profile, config) for each in lines if each.line]
    if not found:
        raise UsageError("`runs`: no pipeline with pictures of two sizes or more; run s2a-bench sweep transports")
    origin = f"{line.removesuffix('.')}; PREDICTED for {profile.about}."
    return sorted(found, key=lambda each: (each.load > 1, each.meets is False, each.e2e_ms)), profile, origin


def fitted(paths: Sequence[Path]) -> tuple[list[FittedPipeline], str]:
    """Return the pipelines of runs without a link that cross a network, and the runs' provenance."""
    runs = [run for path in paths for run in _runs(path) if not run.manifest["configuration"].get("link")]
    lines = [
        each
        for each in against_bytes(split(runs))
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
    least_ms = bound_s(link, size * HEADERS) * 1e3
    paced_ms = max(0.0, _pacing_ms(pipeline, link) - (least_ms - bound_s(link, 0) * 1e3))
    link_ms = least_ms + paced_ms + jitter_ms / 2
    work_ms = line.at(config.pixels_mb)
    reach_ms = line.reach(config.pixels_mb)
    e2e_ms = work_ms + link_ms
    off_ms = 2 * DELAY_OFF_MS + RATE_OFF * (least_ms - bound_s(link, 0) * 1e3) + (jitter_ms + paced_ms) / 2
    ends_ms = None if reach_ms is None else (max(0.0, e2e_ms - reach_ms - off_ms), e2e_ms + reach_ms + off_ms)
    load = size * HEADERS * 8e-6 * config.rate / up.mbps
    low, high = ends_ms or (e2e_ms, e2e_ms)
    meets = False if load > 1 or low > config.deadline_ms else True if high <= config.deadline_ms else None
    coding_ms = 0.0 if pipeline.coding is None else pipeline.coding.at(config.pixels_mb)
    bound_ms = bound_s(link, size) * 1e3
    return Advice(pipeline.name, pipeline.payload, e2e_ms, ends_ms, link_ms, coding_ms, bound_ms, load, meets)


def _pacing_ms(pipeline: FittedPipeline, link: tuple[Direction, Direction]) -> float:
    """Return the least time of a body over this host's TCP if that is BBR; 0 for other TCP, and over UDP.

    BBR paces a body at `BBR_GAIN` times the rate that it has seen, and has seen one body a round trip. So a body takes
    t = (RTT + t) / `BBR_GAIN`, whatever its size, if the link is faster than that.
    """
    if _congestion_control() != "bbr" or pipelines([pipeline.name])[0].options.datagrams:
        return 0.0
    return (link[0].delay_ms + link[1].delay_ms) / (BBR_GAIN - 1)


def _congestion_control() -> str:
    try:
        return Path("/proc/sys/net/ipv4/tcp_congestion_control").read_text(encoding="ascii").strip()
    except OSError:
        return ""


def advice_table(found: Sequence[Advice], config: AdviseConfig, profile: LinkProfile, provenance: str) -> TextTable:
    """Return the table of the predictions."""
    checked = any(each.measured_ms is not None for each in found)
    rows = [
        (
            each.pipeline,
            each.payload,
            number(each.e2e_ms) + (f" [{number(each.ends_ms[0])}, {number(each.ends_ms[1])}]" if each.ends_ms else ""),
            *([_measured(each)] if checked else []),
            number(each.bound_ms),
            each.limit,
            *([f"{each.load:.0%}"] if config.rate else []),
            *([{True: "yes", False: "no", None: "unclear"}[each.meets]] if config.deadline or config.rate else []),
        )
        for each in found
    ]
    header = ("pipeline", "payload", "predicted ms", *(["measured ms"] if checked else []), "bound ms", "limited by")
    header += ("of the rate",) if config.rate else ()
    header += ("meets it",) if config.deadline or config.rate else ()
    notes = (
        PREDICTION,
        BOUND,
        *(["Losses are not predicted: the times hold for requests without one."] if profile.loss else []),
    )
    title = f"{config.cameras} x {config.size[0]}x{config.size[1]} over {profile.about}, predicted"
    return TextTable(title, header, rows, 2, notes=notes, provenance=provenance)


def _measured(advice: Advice) -> str:
    if advice.measured_ms is None:
        return ABSENT
    return number(advice.measured_ms) + {True: ", inside", False: ", outside", None: ""}[advice.inside]


def sentence(found: Sequence[Advice], config: AdviseConfig, profile: LinkProfile) -> str:
    """Return the advice in a sentence."""
    best = found[0]
    if best.load > 1:
        return f"{profile.name} carries {config.rate:g} such requests a second over no transport of the sweep."
    ends = f" [{number(best.ends_ms[0])}, {number(best.ends_ms[1])}]" if best.ends_ms else ""
    text = f"{best.pipeline} with {best.payload} is the quickest over {profile.name}: {number(best.e2e_ms)}{ends} ms"
    if config.deadline:
        meet = sum(each.meets is True for each in found)
        text += f"; {meet} of {len(found)} surely meet {config.deadline_ms:g} ms"
    return f"{text}; the {best.limit} takes the most of it."


def advice_json(found: Sequence[Advice], config: AdviseConfig, profile: LinkProfile, provenance: str) -> dict[str, Any]:
    """Return the object of ``--json``."""
    return {
        "schema": "s2a-bench-advise/1",
        "command": "advise",
        "link": profile.model_dump(mode="json", exclude_defaults=True),
        "provenance": provenance,
        "cells": [{**asdict(each), "limit": each.limit, "inside": each.inside} for each in found],
        "sentence": sentence(found, config, profile),
    }
