"""What is seen of a run that bears on its validity, as typed warnings that say what to do next."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from s2a_bench.clock import realtime_offset_ns
from s2a_bench.facts import FRAMES_LOST, HEADERS_OFF_MS, STALE_FRAMES, USAGE_ZERO
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.harness.session import INTERRUPTED
from s2a_bench.machine.doctor import BEFORE_RUN, CHECKS, Finding, Machine, examine
from s2a_bench.machine.doctor.robot import RMEM_WANTED
from s2a_bench.stats.batches import Memory
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import SampleRow
from s2a_bench.trace import RESIDUAL_LIMIT, Budget, budget

CLOCK_STEP_NS = 50_000_000
SURELY_OFF_MS, SURELY_OFF_SHARE = 20.0, 0.25
"""Beyond both, a llama-server's headers did not leave when its slot started."""


def before_run(config: RequestsConfig | None = None, machine: Machine | None = None) -> list[RunWarning]:
    """Return the doctor's warnings that concern any run, and those that concern the transports of one of requests."""
    checks = {code: CHECKS[code] for code in BEFORE_RUN}
    if config is not None:
        for transport in config.used:
            checks |= {code: transport.checks[code] for code in transport.before_run(config.width, config.height)}
    return warnings_of(examine(machine or Machine(), checks))


def warnings_of(findings: Iterable[Finding]) -> list[RunWarning]:
    """Return the doctor's warnings and errors as runs store them."""
    return [RunWarning(seen.code, seen.message, seen.fix) for seen in findings if seen.level in {"warning", "error"}]


@dataclass(slots=True)
class Counters:
    """Machine counters whose rise during a run is a reason to warn; an unreadable one is None."""

    receive_buffer_errors: int | None = None
    throttles: int | None = None
    suspended_ns: int = 0
    realtime_offset_ns: int = 0

    @staticmethod
    def read(*, watches_udp: bool = True) -> Counters:
        """Read them all; without a transport on UDP the packets that the machine dropped were somebody else's."""
        throttles = [_number(path) or 0 for path in _cpu_files("thermal_throttle/core_throttle_count")]
        suspended = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        return Counters(
            _receive_buffer_errors() if watches_udp else None,
            sum(throttles) if throttles else None,
            suspended,
            realtime_offset_ns(),
        )

    def warnings_since(self, before: Counters, against_loss: str = "") -> list[RunWarning]:
        """Compare with an earlier reading; ``against_loss`` is what transports advise where packets are lost."""
        warnings = []
        if _rise(before.receive_buffer_errors, self.receive_buffer_errors):
            warnings.append(
                RunWarning(
                    "udp-receive-buffer",
                    f"the kernel dropped {_rise(before.receive_buffer_errors, self.receive_buffer_errors)} UDP packets "
                    "for want of receive buffer: DDS had to send them again, 200 ms later",
                    against_loss or f"sudo sysctl -w net.core.rmem_max={4 * RMEM_WANTED}",
                )
            )
        if _rise(before.throttles, self.throttles):
            warnings.append(
                RunWarning("cpu-throttling", "the CPU was throttled during the run", "cool it, and run again")
            )
        if abs(self.suspended_ns - before.suspended_ns) > CLOCK_STEP_NS:
            warnings.append(RunWarning("suspended", "the machine was suspended during the run", "run again"))
        if abs(self.realtime_offset_ns - before.realtime_offset_ns) > CLOCK_STEP_NS:
            warnings.append(
                RunWarning(
                    "clock-jump",
                    "the wall clock was set during the run; latencies are unaffected, ROS time stamps are not",
                    "let NTP settle, and run again",
                )
            )
        return warnings


@dataclass(slots=True)
class SampleGuard:
    """Watches the samples of a run as they come; ``against_loss`` is cell -> what its transport advises then."""

    against_loss: Mapping[str, str] = field(default_factory=dict)
    _frames: dict[tuple[str, int], str] = field(default_factory=dict)
    _repeated: dict[str, int] = field(default_factory=dict)
    _cached: dict[str, int] = field(default_factory=dict)
    _cached_share: float = 0.0
    _residual: dict[str, int] = field(default_factory=dict)
    _failed: dict[str, int] = field(default_factory=dict)
    _frames_lost: dict[str, int] = field(default_factory=dict)
    _stale: dict[str, int] = field(default_factory=dict)
    _in_a_row: dict[str, int] = field(default_factory=dict)
    _succeeded: dict[str, int] = field(default_factory=dict)
    _lost: dict[str, int] = field(default_factory=dict)
    _headers_early: dict[str, int] = field(default_factory=dict)
    _headers_late: dict[str, int] = field(default_factory=dict)
    _uncounted: dict[str, int] = field(default_factory=dict)
    _hits: dict[str, int] = field(default_factory=dict)
    _last: dict[str, str] = field(default_factory=dict)
    _times_ns: dict[str, list[int]] = field(default_factory=dict)
    _launches: set[int] = field(default_factory=set)
    _odd: dict[str, set[str]] = field(default_factory=dict)

    def see(self, row: SampleRow, fingerprint: int) -> None:
        """Look at one sample and the fingerprint of its picture."""
        if self._frames.setdefault((row.cell, fingerprint), row.request_id) != row.request_id:
            _count(self._repeated, row.cell)
        if lost := row.facts.get(FRAMES_LOST):
            self._frames_lost[row.cell] = int(lost)
        self._in_a_row[row.cell] = self._in_a_row.get(row.cell, 0) + 1 if row.error else 0
        if row.error:
            self._see_failure(row)
            return
        if row.cache_n:
            _count(self._cached, row.cell)
            self._cached_share = max(self._cached_share, row.cache_n / (row.cache_n + (row.prompt_n or 0)))
        if not row.warmup:
            _count(self._succeeded, row.cell)
        if USAGE_ZERO in row.facts and row.prompt_n is None:
            _count(self._uncounted, row.cell)
        off_ms = row.facts.get(HEADERS_OFF_MS, 0.0)
        if not row.warmup and abs(off_ms) > max(SURELY_OFF_MS, SURELY_OFF_SHARE * (row.server_prompt_ms or 0.0)):
            _count(self._headers_early if off_ms > 0 else self._headers_late, row.cell)
        if not row.warmup:
            self._see_times(row, budget(row.marks))

    def _see_failure(self, row: SampleRow) -> None:
        """Look at why a request failed."""
        self._last[row.cell] = row.error
        if STALE_FRAMES in row.facts:
            _count(self._stale, row.cell)
        elif row.error != INTERRUPTED:
            _count(self._lost if row.error.startswith("MessagesLost") else self._failed, row.cell)

    def _see_times(self, row: SampleRow, spent: Budget) -> None:
        """Look at where the time of a sample that counts has gone."""
        share, whole_ns = spent.residual_share, spent.e2e_without_inference_ns
        if share is not None and share > RESIDUAL_LIMIT:
            _count(self._residual, row.cell)
        self._launches.add(row.launch)
        self._times_ns.setdefault(row.cell, []).append(spent.e2e_ns if whole_ns is None else whole_ns)

    def see_odd(self, cell: str, names: Iterable[str]) -> None:
        """Look at the names of what a server said that can be no fact."""
        if odd := set(names):
            self._odd.setdefault(cell, set()).update(odd)

    def see_hits(self, before: Mapping[str, float], after: Mapping[str, float]) -> None:
        """Look at what servers count of their caches' hits before the run and after it."""
        rises = {name: round(after[name] - before.get(name, 0.0)) for name in after}
        self._hits.update({name: rise for name, rise in rises.items() if rise > 0})

    def failures_in_a_row(self, cell: str) -> int:
        """Count a cell's failures since its last success."""
        return self._in_a_row.get(cell, 0)

    def last_error(self, cell: str) -> str:
        """Return what went wrong last in a cell, or nothing."""
        return self._last.get(cell, "")

    def successes(self, cell: str) -> int:
        """Count a cell's samples that took part in its numbers."""
        return self._succeeded.get(cell, 0)

    def warnings(self) -> list[RunWarning]:
        """Return what was seen."""
        return [
            *_told(
                self._repeated,
                "duplicate-frames",
                "requests carried a picture that was sent before: a server's cache may have answered",
                "a source that compresses by itself is not stamped: use a longer recording, or the synthetic source",
            ),
            *_told(
                self._cached,
                "prompt-cache",
                f"answers had up to {self._cached_share:.0%} of their prompt from the server's cache: time to first "
                "token is too good",
                "start llama-server with --no-cache-prompt --cache-ram 0, vLLM with --no-enable-prefix-caching; "
                "where --dialect was given, leave it out: a server that is known is asked without its cache",
            ),
            *_told(
                self._hits,
                "server-cache",
                "the server's metrics count hits of its caches during the run: times may be too good",
                "see that nobody else asks it; leave --nonce out; start vLLM with --no-enable-prefix-caching and "
                "--mm-processor-cache-gb 0",
            ),
            *_told(
                self._residual,
                "residual",
                f"samples have more than {RESIDUAL_LIMIT:.0%} of their time outside every stage",
                "look at the machine's load; single samples do no harm to a median",
            ),
            *_told(
                self._headers_early,
                "ingest-unsure",
                "samples whose headers left before the slot started, by the server's own prompt_ms: ingest is "
                "too short, inference too long",
                "where it is most of them, this build sends headers early: compare e2e, and prompt_ms for inference",
            ),
            *_told(
                self._headers_late,
                "ingest-unsure",
                "samples whose headers left after the slot had started, by the server's own prompt_ms: ingest is "
                "too long, inference too short",
                "where it is most of them, this build sends headers late: compare e2e, and prompt_ms for inference",
            ),
            *_told(
                self._uncounted,
                "usage-zero",
                "answers came with a usage of zero tokens: it is left out, and what is cached cannot be known",
                "a gateway may drop the counts: ask the server behind it",
            ),
            *_told(
                self._frames_lost,
                "lost-frames",
                "camera frames did not reach the server, or were overtaken there by the next (over the whole run)",
                self.advice(self._frames_lost),
            ),
            *_told(
                self._stale,
                "stale-frames",
                "requests failed, as the camera's newest frame had come to the server too long ago",
                "see why frames did not come (--fps, lost-frames); --max-frame-age says how old one may be",
            ),
            *_told(self._lost, "lost-messages", "requests lost messages on the way", self.advice(self._lost)),
            *odd_facts(self._odd),
            *_told(self._failed, "failed-samples", "requests failed", "see the column error of samples.csv"),
            *(self._alike() if len(self._launches) == 1 else ()),
        ]

    def advice(self, cells: Iterable[str]) -> str:
        """Return what the transports of cells advise against loss, each once."""
        return "; ".join(dict.fromkeys(self.against_loss[cell] for cell in cells if cell in self.against_loss))

    def _alike(self) -> list[RunWarning]:
        """Look at whether neighbouring samples are too much alike; over several launches no interval asks for more."""
        import numpy as np

        found = []
        for cell, times_ns in self._times_ns.items():
            memory = Memory.of(np.array(times_ns, dtype=np.float64))
            if memory.dependent:
                found.append(f"{cell}: {memory.n} samples tell as much as {memory.effective:.0f}")
        if not found:
            return []
        return [
            RunWarning(
                "autocorrelation",
                f"neighbouring samples are alike: intervals of this launch may be too narrow ({', '.join(found)})",
                "measure several launches, --launches 5, or more samples, --runs",
            )
        ]


def odd_facts(names: Mapping[str, Iterable[str]]) -> list[RunWarning]:
    """Return a warning of what servers said that can be no fact: cell -> names."""
    where = "; ".join(f"{cell}: {', '.join(sorted(odd))}" for cell, odd in names.items() if odd)
    if not where:
        return []
    advice = "these facts are absent where they were odd: ask whoever runs the server"
    return [RunWarning("odd-facts", f"a server told what is no number, or none that can be ({where})", advice)]


def _count(counts: dict[str, int], cell: str) -> None:
    counts[cell] = counts.get(cell, 0) + 1


def _told(counts: dict[str, int], code: str, what: str, advice: str) -> list[RunWarning]:
    if not counts:
        return []
    where = ", ".join(f"{cell}: {count}" for cell, count in counts.items())
    return [RunWarning(code, f"{what} ({where})", advice)]


def _rise(before: int | None, after: int | None) -> int:
    return 0 if before is None or after is None else max(0, after - before)


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _cpu_files(name: str) -> Iterable[Path]:
    return sorted(Path("/sys/devices/system/cpu").glob(f"cpu[0-9]*/{name}"))


def _receive_buffer_errors() -> int | None:
    """Return RcvbufErrors of /proc/net/snmp."""
    try:
        names, values = (
            line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line.startswith("Udp:")
        )
        return int(values[names.index("RcvbufErrors")])
    except (OSError, ValueError):
        return None
