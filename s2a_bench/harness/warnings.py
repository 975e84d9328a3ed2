"""Doubts about a run's validity, as typed warnings that say what to do next."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from s2a_bench.clock import realtime_offset_ns
from s2a_bench.facts import FRAMES_LOST, HEADERS_OFF_MS, RECONNECTS, STALE_FRAMES, USAGE_ZERO
from s2a_bench.harness.session import INTERRUPTED
from s2a_bench.machine.doctor import BEFORE_RUN, CHECKS, Machine, examine, warnings_of
from s2a_bench.machine.doctor.host import RMEM_WANTED
from s2a_bench.policy.conformal import no_promise
from s2a_bench.stats.batches import FEWEST_ROWS, RowCorrelation, Rows
from s2a_bench.stats.change import change_of_ranks
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import SampleRow
from s2a_bench.trace import RESIDUAL_LIMIT, budget
from s2a_bench.transport.pipeline import Pipeline

CLOCK_STEP_NS = 50_000_000
LEVEL: Final = 0.01
"""The significance level of the test for changed delays."""
SURELY_OFF_MS, SURELY_OFF_SHARE = 20.0, 0.25
"""Beyond both, a llama-server's headers did not leave when its slot started."""

AWAKE_MS = 2.0
"""The longest time from the end of a server's sleep to its first answer at the client."""
PILE_MS, PILED = 0.5, 0.1
"""The width of the pile at the end of a sleep, and the share of answers in it that raises the warning."""


def before_run(checks: Mapping[str, str] | None = None, machine: Machine | None = None) -> list[RunWarning]:
    """Return the doctor's warnings that concern any run, and those of a run plan's ``checks``."""
    return warnings_of(examine(machine or Machine(), {code: CHECKS[code] for code in BEFORE_RUN} | dict(checks or {})))


def exchange_warnings(calibrations: Mapping[str, Mapping[str, Any]], advice: str) -> list[RunWarning]:
    """Return where a calibration, as plain data by name, promises nothing."""
    broken = no_promise(calibrations)
    return [RunWarning("not-exchangeable", broken.removesuffix("."), advice)] if broken else []


def change_warnings(name: str, learned: Rows, seen: Rows, unit: str, advice: str) -> list[RunWarning]:
    """Return whether later delays differ from those that a rule learned from, by a rank test on the 1 % level.

    Rows are in order of measurement; fewer than `FEWEST_ROWS` of either are not compared.
    """
    if min(len(learned), len(seen)) < FEWEST_ROWS:
        return []
    change = change_of_ranks(learned, seen)
    if change.p is None or change.p >= LEVEL:
        return []
    before, now = (float(np.median(rows.values)) for rows in (learned, seen))
    what = (
        f"{name}: delays changed since the calibration: a later one is longer with probability "
        f"{change.superiority.value:.2f}; medians {before:.4g} and {now:.4g} {unit}"
    )
    return [RunWarning("delays-changed", what, advice)]


class Counters(NamedTuple):
    """Machine counters; a rise during a run raises a warning, an unreadable one is None."""

    receive_buffer_errors: int | None = None
    throttles: int | None = None
    suspended_ns: int = 0
    realtime_offset_ns: int = 0

    @staticmethod
    def read(*, watches_udp: bool = True) -> Counters:
        """Read all counters; without a transport on UDP, dropped packets are another program's."""
        machine = Machine()
        lines = (machine.read("proc/net/snmp") or "").splitlines() if watches_udp else []
        udp = [line.split() for line in lines if line.startswith("Udp:")]  # names, then values
        dropped = dict(zip(*udp, strict=False)).get("RcvbufErrors", "") if len(udp) == 2 else ""  # noqa: PLR2004
        throttles = machine.read_all("sys/devices/system/cpu/cpu[0-9]*/thermal_throttle/core_throttle_count")
        return Counters(
            int(dropped) if dropped.isdecimal() else None,
            sum(int(count) for count in throttles.values() if count.isdecimal()) if throttles else None,
            time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(time.CLOCK_MONOTONIC),
            realtime_offset_ns(),
        )

    def warnings_since(self, before: Counters, against_loss: str = "") -> Iterator[RunWarning]:
        """Compare with an earlier reading; ``against_loss`` is the transports' advice about lost packets."""
        rises = [0 if old is None or new is None else new - old for old, new in zip(before, self, strict=True)]
        dropped, throttles, suspended_ns, set_ns = rises
        if dropped > 0:
            late = "for want of receive buffer: DDS had to send them again, 200 ms later"
            advice = against_loss or f"sudo sysctl -w net.core.rmem_max={4 * RMEM_WANTED}"
            yield RunWarning("udp-receive-buffer", f"the kernel dropped {dropped} UDP packets {late}", advice)
        if throttles > 0:
            yield RunWarning("cpu-throttling", "the CPU was throttled during the run", "cool it, and run again")
        if abs(suspended_ns) > CLOCK_STEP_NS:
            yield RunWarning("suspended", "the machine was suspended during the run", "run again")
        if abs(set_ns) > CLOCK_STEP_NS:
            what = "the wall clock was set during the run; latencies are unaffected, ROS time stamps are not"
            yield RunWarning("clock-jump", what, "let NTP settle, and run again")


class Doubt(NamedTuple):
    """A reason to doubt the numbers of requests, and the way out."""

    code: str
    what: str
    advice: str = ""
    """Empty: the transports of the cells advise."""
    share: float = 0.0
    """It is raised above this share of a cell's samples."""


REPEATED = Doubt(
    "duplicate-frames",
    "requests carried a picture that was sent before: a server's cache may have answered",
    "a source that compresses by itself is not stamped: use a longer recording, or the synthetic source",
)
CACHED = Doubt(
    "prompt-cache",
    "answers had up to {cached_share:.0%} of their prompt from the server's cache: time to first token is too good",
    "start llama-server with --no-cache-prompt --cache-ram 0, vLLM with --no-enable-prefix-caching; "
    "where --dialect was given, leave it out: requests to a known server bypass its cache",
)
HITS = Doubt(
    "server-cache",
    "the server's metrics count hits of its caches during the run: times may be too good",
    "stop other clients of the server; leave --nonce out; start vLLM with --no-enable-prefix-caching and "
    "--mm-processor-cache-gb 0",
)
RESIDUAL = Doubt(
    "residual",
    f"samples have more than {RESIDUAL_LIMIT:.0%} of their time outside every stage",
    "look at the machine's load; single samples do no harm to a median",
)
HEADERS_EARLY = Doubt(
    "ingest-unsure",
    "samples whose headers left before the slot started, by the server's own prompt_ms: ingest is "
    "too short, inference too long",
    "where it is most of them, this build sends headers early: compare e2e, and prompt_ms for inference",
)
HEADERS_LATE = Doubt(
    "ingest-unsure",
    "samples whose headers left after the slot had started, by the server's own prompt_ms: ingest is "
    "too long, inference too short",
    "where it is most of them, this build sends headers late: compare e2e, and prompt_ms for inference",
)
UNCOUNTED = Doubt(
    "usage-zero",
    "answers came with a usage of zero tokens: it is left out, and the cached share is unknown",
    "a gateway may drop the counts: measure the server behind it",
)
RECONNECTED = Doubt(
    "reconnects",
    "requests found the kept connection closed by the server: connecting again is in their times",
    "let the server, or a proxy before it, keep connections; over HTTP --connection per-request makes it a stage",
    share=0.5,
)
OVERTAKEN = Doubt(
    "lost-frames", "camera frames did not reach the server, or were overtaken there by the next (over the whole run)"
)
STALE = Doubt(
    "stale-frames",
    "requests failed, as the server's newest camera frame was too old",
    "find out why frames did not arrive (--fps, lost-frames); --max-frame-age sets the limit",
)
LOST = Doubt("lost-messages", "requests lost messages on the way")
FAILED = Doubt("failed-samples", "requests failed", "see the column error of samples.csv")
DOUBTS: Final = (
    *(REPEATED, CACHED, HITS, RESIDUAL, HEADERS_EARLY, HEADERS_LATE),
    *(UNCOUNTED, RECONNECTED, OVERTAKEN, STALE, LOST, FAILED),
)
"""The conditions, in the order of the warnings."""


class SampleGuard:
    """Checks the samples of a run's ``cells`` as they arrive."""

    def __init__(self, cells: Iterable[Pipeline] = ()) -> None:
        self.succeeded: Counter[str] = Counter()
        """Samples that count, by cell."""
        self.in_a_row: defaultdict[str, Counter[int]] = defaultdict(Counter)
        """Failures of each client since the last success of any, by cell."""
        self.last_error: dict[str, str] = {}
        self._cells = {cell.name: cell for cell in cells}
        self._sleeps = {name: sleep for name, cell in self._cells.items() if (sleep := cell.transport.sleep)}
        self._waits = {cell: sleep.fact for cell, sleep in self._sleeps.items()}
        self._counts: dict[Doubt, Counter[str]] = {doubt: Counter() for doubt in DOUBTS}
        self._frames: dict[tuple[str, int], str] = {}
        self._cached_share = 0.0
        self._odd: dict[str, set[str]] = defaultdict(set)
        self._times_ns: dict[str, list[int]] = defaultdict(list)
        self._waits_ms: dict[str, list[float]] = defaultdict(list)
        self._launches: set[int] = set()

    def see(self, row: SampleRow, fingerprint: int, odd: Iterable[str] = (), client: int = 0) -> None:
        cell, counts = row.cell, self._counts
        self._odd[cell].update(odd)  # names of impossible facts
        if self._frames.setdefault((cell, fingerprint), row.request_id) != row.request_id:
            counts[REPEATED][cell] += 1
        if lost := row.facts.get(FRAMES_LOST):
            counts[OVERTAKEN][cell] = int(lost)
        if row.error:
            self.in_a_row[cell][client] += 1
            self.last_error[cell] = row.error
            if row.error != INTERRUPTED:
                failed = LOST if row.error.startswith("MessagesLost") else FAILED
                counts[STALE if STALE_FRAMES in row.facts else failed][cell] += 1
            return
        self.in_a_row[cell].clear()
        if row.cache_n:
            counts[CACHED][cell] += 1
            self._cached_share = max(self._cached_share, row.cache_n / (row.cache_n + (row.prompt_n or 0)))
        if USAGE_ZERO in row.facts and row.prompt_n is None:
            counts[UNCOUNTED][cell] += 1
        if row.warmup:
            return
        self.succeeded[cell] += 1
        self._launches.add(row.launch)
        counts[RECONNECTED][cell] += RECONNECTS in row.facts
        self._waits_ms[cell].append(row.facts.get(self._waits.get(cell, ""), 0.0))
        off_ms = row.facts.get(HEADERS_OFF_MS, 0.0)
        if abs(off_ms) > max(SURELY_OFF_MS, SURELY_OFF_SHARE * (row.server_prompt_ms or 0.0)):
            counts[HEADERS_EARLY if off_ms > 0 else HEADERS_LATE][cell] += 1
        spent = budget(row.marks)
        whole_ns = spent.e2e_without_inference_ns
        if (spent.residual_share or 0.0) > RESIDUAL_LIMIT:
            counts[RESIDUAL][cell] += 1
        self._times_ns[cell].append(spent.e2e_ns if whole_ns is None else whole_ns)

    def see_hits(self, before: Mapping[str, float], after: Mapping[str, float]) -> None:
        self._counts[HITS] += Counter({name: round(after[name] - before.get(name, 0.0)) for name in after})

    def warnings(self) -> list[RunWarning]:
        warnings = []
        for cell, sleep in self._sleeps.items():
            waits_ms = self._waits_ms[cell] or [0.0]
            after_ms = np.array(waits_ms) - min(waits_ms)
            pile, beyond = (int(np.sum(after_ms // PILE_MS == place)) for place in (0, 1))
            if 0 <= min(waits_ms) - sleep.ms < AWAKE_MS and pile > max(beyond, PILED * after_ms.size):
                what = f"no answers came earlier than {sleep.ms:.0f} ms after the request, and these together just then"
                doubt = Doubt("padded-answers", f"{what}: the server may have slept", sleep.advice)
                self._counts.setdefault(doubt, Counter())[cell] = pile
        for doubt, counts in self._counts.items():
            if doubt is FAILED:
                warnings += self._odd_facts()
            if cells := {cell: count for cell, count in counts.items() if count > doubt.share * self.succeeded[cell]}:
                where = ", ".join(f"{cell}: {count}" for cell, count in cells.items())
                what = doubt.what.format(cached_share=self._cached_share)
                warnings.append(RunWarning(doubt.code, f"{what} ({where})", doubt.advice or self.advice(cells)))
        return warnings + self._correlated() if len(self._launches) == 1 else warnings

    def _odd_facts(self) -> list[RunWarning]:
        where = "; ".join(f"{cell}: {', '.join(sorted(odd))}" for cell, odd in self._odd.items() if odd)
        what = f"a server reported facts that are not numbers, or impossible ones ({where})"
        advice = "these facts are absent where they were odd: report it to the operator of the server"
        return [RunWarning("odd-facts", what, advice)] if where else []

    def advice(self, cells: Iterable[str]) -> str:
        lossy = [self._cells[name] for name in cells if name in self._cells]
        return "; ".join(dict.fromkeys(cell.transport.against_loss(cell.options) for cell in lossy))

    def _correlated(self) -> list[RunWarning]:
        """Check whether neighbouring samples are correlated; intervals over several launches do not depend on it."""
        correlations = {cell: RowCorrelation.of(np.array(times, np.float64)) for cell, times in self._times_ns.items()}
        where = ", ".join(
            f"{cell}: {correlation.n} samples are worth {correlation.effective:.0f}"
            for cell, correlation in correlations.items()
            if correlation.dependent
        )
        what = f"neighbouring samples are correlated: intervals of this launch may be too narrow ({where})"
        advice = "measure several launches, --launches 5, or more --requests"
        return [RunWarning("autocorrelation", what, advice)] if where else []
