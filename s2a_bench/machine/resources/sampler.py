"""The thread that polls the readers, and the summary of a window between two moments.

A counter's rise is exact between two readings, so the cheap readers are read before and after every request
(`ResourceSampler.edge`), by the thread of the request and outside of its time; the others at the poll rate only. A
window too short for a reader's rate has no rise from it: absent, rather than a share of other work.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import fmean, median
from threading import Event, Lock, Thread
from typing import Any

from s2a_bench.clock import now_ns
from s2a_bench.machine.resources import BOARD_ENERGY_J, ENERGY_J, POWER_W, RESOURCES, Reader, ResourceRow
from s2a_bench.store.run import RunWriter

COUNTERS = ("client_cpu_ns", "server_cpu_ns", "package_energy_j", "gpu_energy_j")
"""Counters; a window's value is the rise."""
PEAKS = ("client_rss_bytes", "server_rss_bytes", "gpu_memory_bytes", "gpu_temperature_c")
"""Columns whose value in a window is the largest; that of all others is the mean."""
ENERGY_OF_POWER = {"gpu_power_w": "gpu_energy_j", "board_power_w": BOARD_ENERGY_J}
"""Power -> energy, integrated if the source has no counter of energy."""
COMPONENTS = ("gpu_energy_j", "package_energy_j")
"""The terms of ``energy_j`` if the board's input is not measured."""
KEPT = 20_000
"""Readings kept for windows: half an hour at 10 Hz, longer than a request. The run folder has all."""
COVERED = 0.5
"""The least share of a window that its readings must span for a rise to be extrapolated to the window."""


@dataclass(frozen=True, slots=True)
class Reading:
    at_ns: int
    cost_ns: int
    values: Mapping[str, float]


@dataclass(slots=True)
class _Source:
    name: str
    reader: Reader
    readings: deque[Reading] = field(default_factory=lambda: deque(maxlen=KEPT))
    lock: Lock = field(default_factory=Lock)
    broken: bool = False

    @property
    def cost_us(self) -> float:
        return median(reading.cost_ns for reading in self.readings) / 1e3 if self.readings else 0.0


class ResourceSampler:
    """Polls readers ``hz`` times a second on a thread, as a context manager."""

    def __init__(
        self,
        readers: Mapping[str, Reader],
        hz: float,
        left_out: Mapping[str, str] | None = None,
        clock: Callable[[], int] = now_ns,
    ) -> None:
        """Own the readers; ``left_out`` has the reasons for the others, for the manifest."""
        self._sources = [_Source(name, reader) for name, reader in readers.items()]
        self._cheap = [source for source in self._sources if source.reader.cheap]
        self._left_out = dict(left_out or {})
        self._hz = hz
        self._clock = clock
        self._rows: deque[ResourceRow] = deque()
        self._stop = Event()
        self._thread = Thread(target=self._run, name="resources", daemon=True)
        self._polls = self._late = 0
        self._started_ns = self._seen_ns = 0
        self._thread_cpu_ns = 0

    def __enter__(self) -> ResourceSampler:  # noqa: PYI034 - Self is typing's since 3.11
        if self._sources:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._sources:
            self._thread.join()
        for source in self._sources:
            source.reader.close()

    def poll(self) -> None:
        for source in self._sources:
            self._read(source)
        self._polls += 1

    def edge(self) -> None:
        """Read the cheap readers at the border of a window; may be called from any thread."""
        for source in self._cheap:
            self._read(source)

    def flush(self, run: RunWriter) -> None:
        if rows := [self._rows.popleft() for _ in range(len(self._rows))]:
            run.append(RESOURCES, rows)

    def window(self, start_ns: int, end_ns: int) -> dict[str, float]:
        """Summarise the time from ``start_ns`` to ``end_ns`` as facts of a sample, by the names of the columns.

        A counter gives its rise, power and shares their mean, memory and temperature their largest value. ``power_w``
        and ``energy_j`` are the board's if it is measured, else the sum of the readable components.
        """
        facts: dict[str, float] = {}
        for source in self._sources:
            with source.lock:
                facts |= _facts(source.readings, start_ns, end_ns, int(1e9 / self._hz))
        components = [facts[name] for name in COMPONENTS if name in facts]
        if BOARD_ENERGY_J in facts:
            facts[ENERGY_J] = facts[BOARD_ENERGY_J]
        elif components:
            facts[ENERGY_J] = sum(components)
        if ENERGY_J in facts and end_ns > start_ns:
            facts[POWER_W] = facts[ENERGY_J] / (end_ns - start_ns) * 1e9
        return facts

    def describe(self) -> dict[str, Any]:
        """Return the manifest's facts: readers, polls, and their cost; none without readers."""
        if not self._sources:
            return {}
        elapsed_ns = self._seen_ns - self._started_ns
        return {
            "hz": self._hz,
            "readers": {source.name: source.reader.about for source in self._sources},
            "left_out": self._left_out,
            "polls": self._polls,
            "late": self._late,
            "cost_us": {source.name: round(source.cost_us, 1) for source in self._sources if source.readings},
            "edge_us": round(sum(source.cost_us for source in self._cheap), 1),
            "core_share": round(self._thread_cpu_ns / elapsed_ns, 6) if elapsed_ns else None,
        }

    def _read(self, source: _Source) -> None:
        """Take a reading; a reader that fails is not read again, and ends no run."""
        with source.lock:  # keeps a source's readings in order of time
            if source.broken:
                return
            before = self._clock()
            try:
                values = source.reader.read()
            except Exception as error:  # noqa: BLE001 - drivers and foreign clients raise anything
                source.broken = True
                self._left_out[source.name] = f"stopped after {len(source.readings)} readings: {error!r}"
                return
            cost_ns = self._clock() - before
            at_ns = before + cost_ns // 2
            source.readings.append(Reading(at_ns, cost_ns, values))
            self._rows.append(ResourceRow(at_ns, source.name, cost_ns, **values))  # type: ignore[arg-type]

    def _run(self) -> None:
        """Poll at absolute times, so that the time of polls does not add up; a missed time is skipped."""
        period_ns = int(1e9 / self._hz)
        self._started_ns = due_ns = self._clock()
        while True:
            self.poll()
            self._thread_cpu_ns = time.thread_time_ns()
            self._seen_ns = self._clock()
            due_ns += period_ns
            missed = max(0, self._seen_ns - due_ns) // period_ns
            self._late += missed
            due_ns += missed * period_ns
            if self._stop.wait(max(0, due_ns - self._seen_ns) / 1e9):
                return


def _facts(readings: deque[Reading], start_ns: int, end_ns: int, period_ns: int) -> dict[str, float]:
    """Summarise one source's readings of a window; without any it uses a recent one before it."""
    inside: list[Reading] = []
    before: Reading | None = None
    for reading in reversed(readings):
        if reading.at_ns < start_ns:
            before = reading
            break
        if reading.at_ns <= end_ns:
            inside.append(reading)
    inside.reverse()
    held = inside or ([before] if before and end_ns - before.at_ns <= 2 * period_ns else [])
    facts: dict[str, float] = {}
    for name in dict.fromkeys(name for reading in held for name in reading.values):
        values = [(reading.at_ns, reading.values[name]) for reading in held if name in reading.values]
        if name not in COUNTERS:
            facts[name] = max(value for _, value in values) if name in PEAKS else fmean(value for _, value in values)
        elif (rise := _rise(values, start_ns, end_ns)) is not None:
            facts[name] = rise
    for power, energy in ENERGY_OF_POWER.items():
        times = [reading.at_ns for reading in inside if power in reading.values]
        if energy not in facts and len(times) > 1 and times[-1] - times[0] >= COVERED * (end_ns - start_ns):
            facts[energy] = facts[power] * (end_ns - start_ns) / 1e9
    return facts


def _rise(values: list[tuple[int, float]], start_ns: int, end_ns: int) -> float | None:
    """Return a counter's rise in a window; None if its readings do not span `COVERED` of it."""
    (first_ns, first), (last_ns, last) = values[0], values[-1]
    if last_ns <= first_ns or last_ns - first_ns < COVERED * (end_ns - start_ns):
        return None
    return (last - first) * (end_ns - start_ns) / (last_ns - first_ns)
