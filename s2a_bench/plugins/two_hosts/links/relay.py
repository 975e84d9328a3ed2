"""The relay of an emulated link: packets between two TUN devices, held in a heap until they are due.

``python -m s2a_bench.plugins.two_hosts.links.relay`` reads one JSON line from standard input: the devices'
descriptors, and both directions. It answers each further line with its statistics, and ends with its input. It
carries about 1 Gbit/s, so that neither tc nor netem is needed, which not every kernel has.
"""

from __future__ import annotations

import ctypes
import gc
import heapq
import json
import math
import os
import sys
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from random import Random
from select import select
from statistics import median
from typing import Any, Final

from s2a_bench.clock import now_ns
from s2a_bench.plugins.two_hosts.profiles import Direction, Step

PACKET_BYTES: Final = 2048
AT_ONCE: Final = 64
"""Packets read from one device before the other has its turn."""
MOST_HELD: Final = 200_000
"""Packets of about 300 MB."""
PR_SET_TIMERSLACK: Final = 29
LAST: Final = 100_000
"""Packets whose lateness is kept."""
IPV4: Final = 4


class Shaper:
    """When each packet of one direction arrives; times in s since the start of the link."""

    def __init__(self, way: Direction) -> None:
        self._way = way
        self._random = Random(way.seed)  # noqa: S311 - reproducible
        self._starts = [step.start_s for step in way.steps]
        self._credit = way.burst_bytes
        self._free_s = self._last_s = 0.0
        self.lost = self.dropped = 0
        """Packets lost by chance, and those that a full queue dropped."""

    def due_s(self, now_s: float, size: int) -> float | None:
        """Return when a packet that is sent now arrives; None: it is lost."""
        way, start_s = self._way, max(now_s, self._free_s)
        delay_ms, loss = way.delay_ms, way.loss
        if way.steps:
            step, _ = self._step(now_s)
            delay_ms, loss = step.delay_ms, step.loss
        if loss and self._random.random() < loss:
            self.lost += 1
            return None
        if start_s - now_s > way.queue_ms / 1e3:
            self.dropped += 1
            return None
        fast = 0.0
        if way.burst_bytes:
            self._credit = min(way.burst_bytes, self._credit + (start_s - self._free_s) * way.mbps * 125e3)
            fast = min(float(size), self._credit)
            self._credit -= fast
        self._free_s = self._sent_s(start_s + fast * 8e-6 / way.burst_mbps, size - fast)
        jitter_s = way.jitter_ms * self._random.random() / 1e3 if way.jitter_ms else 0.0
        self._last_s = max(self._last_s, self._free_s + delay_ms / 1e3 + jitter_s)
        return self._last_s

    def _sent_s(self, start_s: float, size: float) -> float:
        if not self._way.steps:
            return start_s + size * 8e-6 / self._way.mbps
        while True:
            step, left_s = self._step(start_s)
            needed_s = size * 8e-6 / step.mbps if step.mbps else math.inf
            if needed_s <= left_s:
                return start_s + needed_s
            size -= left_s * step.mbps * 125e3
            start_s += left_s + 1e-9  # past the edge, whatever rounding does

    def _step(self, at_s: float) -> tuple[Step, float]:
        """Return the step at a time, and how long it lasts from there."""
        at_s %= self._way.period_s
        index = bisect_right(self._starts, at_s) - 1
        end_s = self._starts[index + 1] if index + 1 < len(self._starts) else self._way.period_s
        return self._way.steps[index], end_s - at_s


class Relay:
    """Moves packets between the client's device and the server's."""

    def __init__(self, devices: Sequence[int], directions: Sequence[Mapping[str, Any]]) -> None:
        client, server = devices
        self._shapers = [Shaper(Direction.from_facts(facts)) for facts in directions]
        self._ways = {client: (self._shapers[0], server), server: (self._shapers[1], client)}
        self._held: list[tuple[float, int, int, bytes]] = []
        self._number = 0
        self._late_s = deque[float](maxlen=LAST)
        self._started_ns = now_ns()

    def _now_s(self) -> float:
        return (now_ns() - self._started_ns) / 1e9

    def facts(self) -> dict[str, Any]:
        late_ms = [1e3 * late_s for late_s in sorted(self._late_s)] or [0.0]
        return {
            "packets": self._number,
            "lost": sum(shaper.lost for shaper in self._shapers),
            "dropped": sum(shaper.dropped for shaper in self._shapers),
            "late_ms": {"median": median(late_ms), "p99": late_ms[int(0.99 * len(late_ms))]},
            "cpu_s": sum(os.times()[:2]),
        }

    def run_until(self, control: int) -> None:
        """Return when the descriptor ``control`` can be read."""
        held = self._held
        while True:
            self._deliver()
            wait_s = max(0.0, held[0][0] - self._now_s()) if held else None
            ready, _, _ = select([*self._ways, control], [], [], wait_s)
            for device in ready:
                if device == control:
                    return
                self._take(device)

    def _deliver(self) -> None:
        now_s = self._now_s()
        while self._held and self._held[0][0] <= now_s:
            due_s, _, device, packet = heapq.heappop(self._held)
            with suppress(OSError):  # its receive queue is full
                os.write(device, packet)
            self._late_s.append(now_s - due_s)

    def _take(self, device: int) -> None:
        shaper, target = self._ways[device]
        for _ in range(AT_ONCE):
            try:
                packet = os.read(device, PACKET_BYTES)
            except BlockingIOError:
                return
            due_s = shaper.due_s(self._now_s(), len(packet)) if packet[0] >> 4 == IPV4 else None
            if due_s is not None and len(self._held) < MOST_HELD:
                self._number += 1
                heapq.heappush(self._held, (due_s, self._number, target, packet))


def main() -> None:
    with suppress(OSError):  # not allowed in a user namespace: then the scheduler decides
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    gc.disable()  # a collection would delay packets
    control, answers = sys.stdin.buffer, sys.stdout
    job = json.loads(control.readline())
    number = control.fileno()
    for device in job["devices"]:
        os.set_blocking(device, False)
    relay = Relay(job["devices"], job["directions"])
    print(json.dumps({"address": ""}), file=answers, flush=True)
    relay.run_until(number)
    while control.readline():
        print(json.dumps(relay.facts()), file=answers, flush=True)
        relay.run_until(number)


if __name__ == "__main__":
    main()
