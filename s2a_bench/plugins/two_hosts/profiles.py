"""Link profiles: rate, delay, jitter and loss of a network between client and server, and the bound that follows.

A rate counts the bits of IP packets. A delay is one-way; jitter adds a uniform share of itself, and packets keep their
order. Lost packets take none of the rate. After idle the first ``burst_kib`` travel at ``burst_mbps``, the rest at the
rate; the credit grows at the rate while the link is idle.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Annotated, Any, Final

from pydantic import Field

from s2a_bench.errors import UsageError
from s2a_bench.text import none_of
from s2a_bench.toml_file import Line, TomlTable, checked, loads, read

PUBLISHED: Final = Path(__file__).with_name("published.toml")
OPPORTUNITY_BYTES: Final = 1500
"""Bytes of a delivery opportunity in mahimahi's traces."""
MOST_STEPS: Final = 1_000_000
STEP_S, MEMORY_S, SYNTHETIC_S = 0.1, 1.0, 600.0
"""The step of a synthetic rate, its correlation time, and its period."""
OFF, DELAY_OFF_MS = 0.05, 0.3
"""The tolerance of an emulated link: a share of its profile's rate and delay, and ms of each delay."""
KEYS: Final = {"delay": "delay_ms", "jitter": "jitter_ms", "up": "up_mbps", "down": "down_mbps"}

Rate = Annotated[float, Field(gt=0, le=1e6)]
Delay = Annotated[float, Field(ge=0, le=60_000)]
Share = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True, slots=True)
class Step:
    """A part of a trace, which lasts until the next starts."""

    start_s: float
    mbps: float
    delay_ms: float
    loss: float


@dataclass(frozen=True, slots=True)
class Direction:
    """One direction of a link; ``mbps`` is infinite if it is not limited, the greatest of ``steps`` if it has any."""

    mbps: float
    delay_ms: float = 0.0
    """The delay without jitter; with ``steps`` the least of them."""
    jitter_ms: float = 0.0
    loss: float = 0.0
    burst_bytes: float = 0.0
    burst_mbps: float = math.inf
    queue_ms: float = 1000.0
    seed: int = 0
    steps: tuple[Step, ...] = ()
    period_s: float = 0.0
    """The steps repeat after it."""

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any]) -> Direction:
        """Read plain data, in which an infinite rate may be None."""
        finite: dict[str, Any] = {name: math.inf if value is None else value for name, value in facts.items()}
        return cls(**{**finite, "steps": tuple(Step(**step) for step in facts["steps"])})

    @property
    def usual_ms(self) -> float:
        """The mean delay: a uniform share of the jitter is added."""
        return self.delay_ms + self.jitter_ms / 2

    def least_s(self, size: float) -> float:
        """Return the least time in s that so many bytes take."""
        fast = min(size, self.burst_bytes)
        return self.delay_ms / 1e3 + fast * 8e-6 / self.burst_mbps + (size - fast) * 8e-6 / self.mbps


class LinkProfile(TomlTable):
    """A link between client and server; up is from the client to the server."""

    name: str = ""
    up_mbps: Rate | None = None
    """None: not limited."""
    down_mbps: Rate | None = None
    delay_ms: Delay = 0.0
    jitter_ms: Delay = 0.0
    loss: Share = 0.0
    burst_kib: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    burst_mbps: Rate | None = None
    queue_ms: Annotated[float, Field(gt=0, le=60_000)] = 1000.0
    """The longest wait for the rate; a packet beyond it is lost, as in a router's full buffer."""
    rate_cv: Annotated[float, Field(ge=0, le=2)] = 0.0
    outage_every_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Mean time between synthetic outages; 0: none."""
    outage_s: Annotated[list[Annotated[float, Field(ge=0, le=60)]], Field(min_length=2, max_length=2)] = Field([1, 1])
    """Shortest and longest outage."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    trace: str = ""
    """CSV file of both directions: t_s, up_mbps, down_mbps, and perhaps delay_ms and loss."""
    up_trace: str = ""
    """File in mahimahi's format: a line for each opportunity to deliver 1,500 bytes, in ms."""
    down_trace: str = ""
    source: Line = "the user's"

    @property
    def about(self) -> str:
        return f"{self.name} ({self.source})"

    def directions(self) -> tuple[Direction, Direction]:
        """Return up and down, their traces read; raises UsageError naming file and line."""
        return self._direction("up"), self._direction("down")

    def _direction(self, name: str) -> Direction:
        mbps, mahimahi = getattr(self, f"{name}_mbps"), getattr(self, f"{name}_trace")
        rate, seed = mbps or math.inf, 2 * self.seed + (1 if name == "down" else 0)
        steps: list[Step] = []
        period_s = 0.0
        if self.trace:
            steps, period_s = _csv_steps(self.trace, f"{name}_mbps", self)
        elif mahimahi:
            steps, period_s = _mahimahi_steps(mahimahi, self)
        elif self.rate_cv or self.outage_every_s:
            if math.isinf(rate):
                raise UsageError(f"`link`: {self.name} needs a rate for `rate_cv` or `outage_every_s`")
            steps, period_s = [*_synthetic_steps(self, rate, seed)], SYNTHETIC_S
        return Direction(
            max((step.mbps for step in steps), default=rate),
            min((step.delay_ms for step in steps), default=self.delay_ms),
            self.jitter_ms,
            self.loss,
            self.burst_kib * 1024 if mbps else 0.0,
            self.burst_mbps or math.inf,
            self.queue_ms,
            seed,
            tuple(steps),
            period_s,
        )


def bound_s(link: tuple[Direction, Direction], bytes_up: float) -> float:
    """Return the least time in s of a request on a link: its body up, and the delay down."""
    return link[0].least_s(bytes_up) + link[1].least_s(0)


def published() -> dict[str, LinkProfile]:
    tables = loads(PUBLISHED.read_text(encoding="utf-8"), str(PUBLISHED))
    return {
        name: checked(LinkProfile, {"name": name} | table, f"{PUBLISHED}: {name}") for name, table in tables.items()
    }


def load_link(text: str) -> LinkProfile:
    """Return the profile of a name, of a file (TOML or a CSV trace), or of KEY=VALUE pairs, which may follow either.

    Pairs are keys of a profile, ``rate=UP/DOWN`` or ``rate=BOTH``, ``delay`` and ``jitter`` in ms, ``loss`` as a share
    or with %. Raises UsageError.
    """
    first, *pairs = text.split(",")
    values: dict[str, Any] = {}
    if "=" in first:
        pairs.insert(0, first)
    elif first.endswith(".csv"):
        values = {"trace": first}
    elif "/" in first or first.endswith(".toml"):
        values = {"name": Path(first).stem, **loads(read(first, "link"), f"link {first}")}
    elif first in (profiles := published()):
        values = profiles[first].model_dump(exclude_unset=True)
    else:
        raise UsageError(f"`link`: {none_of(first, profiles, ', and no file (.toml, .csv) and no KEY=VALUE')}")
    for pair in pairs:
        values |= _pair(pair)
    named = {"name": text} | values
    return checked(LinkProfile, named | {"name": text} if pairs else named, "`link`")


def _pair(text: str) -> dict[str, Any]:
    key, _, value = text.partition("=")
    if key in {"trace", "up_trace", "down_trace", "source"}:
        return {key: value}
    try:
        if key == "rate":
            up, _, down = value.partition("/")
            return {"up_mbps": float(up), "down_mbps": float(down or up)}
        share = key == "loss" and value.endswith("%")
        number = float(value.removesuffix("%")) / 100 if share else float(value)
    except ValueError:
        raise UsageError(f"`link`: '{text}' should be KEY=NUMBER, as rate=54 or rate=18.75/75, loss=10%") from None
    return {KEYS.get(key, key): int(number) if key == "seed" else number}


def _csv_steps(path: str, column: str, profile: LinkProfile) -> tuple[list[Step], float]:
    def value(row: Mapping[str, str], name: str, most: float, default: float = math.nan) -> float:
        number = float(row.get(name) or default)
        if not 0 <= number <= most:
            raise ValueError(f"{name} {number:g} should be 0 to {most:g}")
        return number

    steps: list[Step] = []
    where = f"link trace {path}"
    reader = csv.DictReader(_lines(path))
    if missing := {"t_s", "up_mbps", "down_mbps"} - set(reader.fieldnames or ()):
        raise UsageError(f"{where}: the first line should name the column {', '.join(sorted(missing))}")
    for row in reader:
        try:
            start_s, mbps = value(row, "t_s", 1e9), value(row, column, 1e6)
            delay_ms, loss = value(row, "delay_ms", 6e4, profile.delay_ms), value(row, "loss", 1, profile.loss)
            steps.append(Step(start_s, mbps, delay_ms, loss))
        except (TypeError, ValueError) as error:
            raise UsageError(f"{where}, line {reader.line_num}: {error}") from None
    last_s = steps[-1].start_s - steps[-2].start_s if len(steps) > 1 else 1.0
    return _checked_steps(steps, where), (steps[-1].start_s if steps else 0) + last_s


def _mahimahi_steps(path: str, profile: LinkProfile) -> tuple[list[Step], float]:
    where = f"link trace {path}"
    times: list[int] = []
    for number, line in enumerate(_lines(path), 1):
        if not (line.strip().isdecimal() and len(line) < 12 and int(line) >= (times[-1] if times else 0)):  # noqa: PLR2004
            raise UsageError(f"{where}, line {number}: should be a whole number of ms, not less than the one before")
        times.append(int(line))
    opportunities = Counter(max(time - 1, 0) for time in times)  # in the ms that ends then
    starts = {0: 0, **{ms + 1: 0 for ms in opportunities if ms + 1 < times[-1]}, **opportunities}
    mbps = {ms: count * OPPORTUNITY_BYTES * 8e-3 for ms, count in starts.items()}
    steps = [Step(ms / 1e3, mbps[ms], profile.delay_ms, profile.loss) for ms in sorted(mbps)]
    return _checked_steps(steps, where), max(times[-1] if times else 0, 1) / 1e3


def _lines(path: str) -> list[str]:
    return read(path, "link", 64 * MOST_STEPS).splitlines()


def _checked_steps(steps: list[Step], where: str) -> list[Step]:
    if len(steps) > MOST_STEPS or not any(step.mbps for step in steps):
        raise UsageError(f"{where}: should have 1 to {MOST_STEPS} steps, and a rate")
    if steps[0].start_s or any(one.start_s >= two.start_s for one, two in pairwise(steps)):
        raise UsageError(f"{where}: its times should start at 0 and increase")
    return steps


def _synthetic_steps(profile: LinkProfile, mbps: float, seed: int) -> Iterator[Step]:
    """Yield a log-normal rate of mean ``mbps`` with memory, which is 0 during outages of uniform length."""
    rate, outage = Random(seed), Random(profile.seed)  # noqa: S311 - reproducible; outages hit both directions
    sigma, kept = math.sqrt(math.log1p(profile.rate_cv**2)), math.exp(-STEP_S / MEMORY_S)
    level, until_s = rate.gauss(0, 1), -1.0
    next_s = outage.expovariate(1 / profile.outage_every_s) if profile.outage_every_s else math.inf
    for number in range(round(SYNTHETIC_S / STEP_S)):
        now_s = number * STEP_S
        if now_s >= next_s:
            until_s = now_s + outage.uniform(*profile.outage_s)
            next_s = until_s + outage.expovariate(1 / profile.outage_every_s)
        level = kept * level + math.sqrt(1 - kept * kept) * rate.gauss(0, 1)
        factor = 0.0 if now_s < until_s else math.exp(sigma * level - sigma * sigma / 2)
        yield Step(now_s, mbps * factor, profile.delay_ms, profile.loss)
