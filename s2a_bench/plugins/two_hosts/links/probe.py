"""The probe of an emulated link: plain UDP sockets measure what it carries, before a run and apart from the relay."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from select import select
from statistics import median
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import UsageError
from s2a_bench.plugins.two_hosts.profiles import DELAY_OFF_MS, OFF, Direction

if TYPE_CHECKING:
    from s2a_bench.plugins.two_hosts.links import EmulatedLink

SERVER, CLIENT = "127.0.0.1", "127.0.0.2"
ATTEMPTS: Final = 3
RATE_S: Final = 1.0
OFFERED: Final = 1.15
"""Offered load over the rate."""
IP_BYTES, UDP_BYTES, PACKET_BYTES, SMALL_BYTES = 20, 8, 1500, 128
"""The sizes of headers, of a full packet, and of a packet for counts and round trips, headers included."""
FRAGMENTS: Final = 10
"""Packets of a datagram where none is lost: Python sends some 50,000 datagrams a second."""
COUNTED: Final = 2000
COUNTED_PER_S: Final = 4000.0
PINGS: Final = 30
IDLE_S: Final = 0.02
SILENT_S: Final = 0.3
"""Beyond the round trip: nothing more comes."""
SIGMAS: Final = 4.0
STRAY: Final = 0.002
"""Share of packets that a busy machine may lose."""
SO_RCVBUFFORCE: Final = 33
BUFFER_BYTES: Final = 16 << 20
AT_ONCE: Final = 32
"""Packets sent before the receiver is read."""


@dataclass(frozen=True, slots=True)
class Measurement:
    what: str
    unit: str
    profile: float
    measured: float
    tolerance: float

    @property
    def off(self) -> bool:
        return not abs(self.measured - self.profile) <= self.tolerance

    def __str__(self) -> str:
        return f"{self.what} {self.measured:.4g} instead of {self.profile:.4g} {self.unit}".rstrip()


def probed(link: EmulatedLink) -> dict[str, Any]:
    """Measure a link, again if it does not match its profile, and return the manifest's entry; a trace is not checked.

    Raises UsageError if the last attempt is off as well.
    """
    attempts, off = 0, [""]
    while off and attempts < ATTEMPTS:
        attempts += 1
        with ExitStack() as stack:
            quantities = list(_Probe(link, stack).measure())
        off = [str(each) for each in quantities if each.off]
    if off:
        raise UsageError(
            f"`link`: this machine does not carry {link.profile.name} within {OFF:.0%}: {'; '.join(off)}; "
            "stop other programs, or choose a slower link"
        )
    return {"probe": {"attempts": attempts, "quantities": [asdict(each) for each in quantities]}}


class _Probe:
    def __init__(self, link: EmulatedLink, stack: ExitStack) -> None:
        with link.server_side():
            self._server, self._beside = (_socket(SERVER, stack) for _ in range(2))
        self._client = _socket(CLIENT, stack)
        self._directions = up, down = link.directions
        self._round_s = sum(way.delay_ms + way.jitter_ms for way in (up, down)) / 1e3

    def measure(self) -> Iterator[Measurement]:
        up, down = self._directions
        if up.steps or down.steps:
            return
        ways = ("up", up, self._client, self._server), ("down", down, self._server, self._client)
        there_ms = self._round_trips(self._client, self._server)
        here_ms = self._round_trips(self._beside, self._server)
        if there_ms:
            usual_ms = sum(1e3 * way.least_s(SMALL_BYTES) + way.jitter_ms / 2 for way in (up, down)) / 2
            added_ms = (median(there_ms) - median(here_ms)) / 2
            yield Measurement("added one-way delay", "ms", usual_ms, added_ms, DELAY_OFF_MS + OFF * usual_ms)
        for name, way, sender, receiver in ways:
            yield self._loss(name, way, sender, receiver)
            if way.burst_bytes and math.isfinite(way.burst_mbps):
                yield self._burst(name, way, sender, receiver)
            if math.isfinite(way.mbps):
                yield self._rate(name, way, sender, receiver)

    def _round_trips(self, sender: socket.socket, receiver: socket.socket) -> list[float]:
        """Return round trips in ms, each after idle, without those that lost a packet."""
        clock, times_ms = SystemClock(), []
        for each in (sender, receiver):
            each.settimeout(self._round_s + SILENT_S)
        for number in range(PINGS):
            clock.sleep_until_ns(now_ns() + round(IDLE_S * 1e9))
            sent_ns, data = now_ns(), number.to_bytes(SMALL_BYTES - IP_BYTES - UDP_BYTES, "big")
            sender.sendto(data, receiver.getsockname())
            with suppress(TimeoutError):
                _receive(receiver, data)
                receiver.sendto(data, sender.getsockname())
                _receive(sender, data)
                times_ms.append((now_ns() - sent_ns) / 1e6)
        return times_ms

    def _loss(self, name: str, way: Direction, sender: socket.socket, receiver: socket.socket) -> Measurement:
        mbps = min(way.mbps / 2, COUNTED_PER_S * SMALL_BYTES * 8e-6)
        lost = 1 - len(self._train(sender, receiver, COUNTED, SMALL_BYTES, mbps)) / COUNTED
        spread = SIGMAS * math.sqrt(way.loss * (1 - way.loss) / COUNTED)
        return Measurement(f"loss {name}", "", way.loss, lost, spread + STRAY)

    def _burst(self, name: str, way: Direction, sender: socket.socket, receiver: socket.socket) -> Measurement:
        SystemClock().sleep_until_ns(now_ns() + round(way.burst_bytes * 8e3 / way.mbps))  # until the credit is full
        arrivals = self._train(sender, receiver, int(way.burst_bytes // PACKET_BYTES), PACKET_BYTES, math.inf)
        measured = _mbps(arrivals, PACKET_BYTES)
        return Measurement(f"burst {name}", "Mbit/s", way.burst_mbps, measured, OFF * way.burst_mbps)

    def _rate(self, name: str, way: Direction, sender: socket.socket, receiver: socket.socket) -> Measurement:
        mbps, size = way.mbps * OFFERED / (1 - way.loss), PACKET_BYTES * (1 if way.loss else FRAGMENTS)
        count = math.ceil(RATE_S * mbps * 125e3 / size)
        arrivals = self._train(sender, receiver, count, size, mbps)[math.ceil(way.burst_bytes / size) :]
        return Measurement(f"rate {name}", "Mbit/s", way.mbps, _mbps(arrivals, size), OFF * way.mbps)

    def _train(self, sender: socket.socket, receiver: socket.socket, count: int, size: int, mbps: float) -> list[int]:
        """Send packets at a rate; return when each that was not lost arrived, in ns."""
        data = bytes(size - IP_BYTES * math.ceil(size / PACKET_BYTES) - UDP_BYTES)
        target, buffer = receiver.getsockname(), bytearray(len(data))
        receiver.setblocking(False)
        sent, arrivals, gap_ns = 0, list[int](), size * 8e3 / mbps
        started_ns = last_ns = now_ns()
        while sent < count or now_ns() < last_ns + (self._round_s + SILENT_S) * 1e9:
            due = min(count, sent + AT_ONCE, int((now_ns() - started_ns) / gap_ns) + 1 if gap_ns else count)
            for _ in range(sent, due):
                sender.sendto(data, target)
            sent = max(sent, due)
            with suppress(BlockingIOError):
                while receiver.recv_into(buffer):
                    arrivals.append(now_ns())
            last_ns = now_ns() if sent < count else max([last_ns, *arrivals[-1:]])
            if len(arrivals) == count:
                break
            pause_s = max(gap_ns / 1e9, 0.0005) if gap_ns else 0.0
            select([receiver], [], [], SILENT_S if sent == count else pause_s)
        return arrivals


def _socket(address: str, stack: ExitStack) -> socket.socket:
    receiver = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    receiver.bind((address, 0))
    with suppress(PermissionError):  # the usual buffer holds some 180 packets
        receiver.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES)
    return receiver


def _receive(receiver: socket.socket, data: bytes) -> None:
    while receiver.recv(PACKET_BYTES) != data:
        pass


def _mbps(arrivals: Sequence[int], size: int) -> float:
    span_ns = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0
    return (len(arrivals) - 1) * size * 8e3 / span_ns if span_ns else 0.0
