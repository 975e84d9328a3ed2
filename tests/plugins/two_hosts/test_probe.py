"""The probe of a link, in virtual time: it finds what a link carries, and what is off."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plugins.two_hosts.links import CLIENT, SERVER
from s2a_bench.plugins.two_hosts.links import probe as room
from s2a_bench.plugins.two_hosts.links.probe import Measurement, probed
from s2a_bench.plugins.two_hosts.links.relay import Shaper
from s2a_bench.plugins.two_hosts.profiles import Direction, Step, load_link

LOCAL_MS = 0.05
"""What a packet within one side takes."""


class Net:
    """Two sides joined by shapers; reading the clock takes a microsecond."""

    def __init__(self, up: Direction, down: Direction) -> None:
        self.ns, self.directions = 0, (up, down)
        self.shapers = {CLIENT: Shaper(up), SERVER: Shaper(down)}
        self.sent: list[tuple[str, int, int]] = []

    def now_ns(self) -> int:
        self.ns += 1000
        return self.ns

    def sleep_until_ns(self, at_ns: int) -> None:
        self.ns = max(self.ns, at_ns)

    def select(self, sockets: Sequence[Socket], _: object, __: object, timeout_s: float) -> None:
        coming = [each.inbox[0][0] for each in sockets if each.inbox]
        self.ns = max(self.ns, min([self.ns + round(timeout_s * 1e9), *coming]))


class Socket:
    """A datagram socket of one side."""

    def __init__(self, net: Net, address: str) -> None:
        self.net, self.address, self.inbox = net, address, list[tuple[int, int, bytes]]()
        self.timeout_s: float | None = None

    def getsockname(self) -> Any:
        return self

    def settimeout(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def sendto(self, data: bytes, target: Socket) -> None:
        """Send fragments of at most 1,500 bytes; the last to arrive completes the datagram."""
        size = len(data) + 8
        packets = [1500] * (size // 1480) + ([size % 1480 + 20] if size % 1480 else [])
        self.net.sent.append((self.address, self.net.ns, sum(packets)))
        dues: list[float | None] = [self.net.ns / 1e9 + LOCAL_MS / 1e3]
        if target.address != self.address:
            dues = [self.net.shapers[self.address].due_s(self.net.ns / 1e9, each) for each in packets]
        if None not in dues:
            at_ns = round(max(filter(None, dues)) * 1e9)
            heapq.heappush(target.inbox, (at_ns, len(self.net.sent), data))

    def recv(self, _: int) -> bytes:
        until_ns = self.net.ns + round(self.timeout_s * 1e9)
        if not self.inbox or self.inbox[0][0] > until_ns:
            self.net.ns = until_ns
            raise TimeoutError
        at_ns, _, data = heapq.heappop(self.inbox)
        self.net.ns = max(self.net.ns, at_ns)
        return data

    def recv_into(self, _: bytearray) -> int:
        if not self.inbox or self.inbox[0][0] > self.net.ns:
            raise BlockingIOError
        return len(heapq.heappop(self.inbox)[2])


class Link:
    """A link whose profile says ``directions``, and which carries what ``net`` does."""

    def __init__(self, net: Net, directions: tuple[Direction, Direction]) -> None:
        self.net, self.directions, self.profile = net, directions, SimpleNamespace(name="mine")

    @contextmanager
    def server_side(self) -> Iterator[None]:
        yield


def quantities(
    patch: pytest.MonkeyPatch, directions: tuple[Direction, Direction], carried: tuple[Direction, Direction]
) -> dict[str, Measurement]:
    """Probe once a link that carries ``carried`` instead of its ``directions``."""
    net = Net(*carried)
    patch.setattr(room, "_socket", lambda address, _: Socket(net, address))
    patch.setattr(room, "now_ns", net.now_ns)
    patch.setattr(room, "SystemClock", lambda: net)
    patch.setattr(room, "select", net.select)
    link: Any = Link(net, directions)
    found = [*room._Probe(link, None).measure()]  # type: ignore[arg-type]
    pings = [start_ns for address, start_ns, _ in net.sent[: 2 * room.PINGS] if address == CLIENT]
    assert {size for _, _, size in net.sent[: 2 * room.PINGS]} <= {room.SMALL_BYTES}
    assert all(later - earlier >= 20e6 for earlier, later in pairwise(pings))  # each after idle
    return {each.what: each for each in found}


LINKS = {
    "both": "rate=20/60,delay=5",
    "loss": "rate=30,loss=10%,delay=2",
    "burst": "rate=20,burst_kib=150,burst_mbps=60",
    "burst of a slow link": "rate=1,burst_kib=30,burst_mbps=90",
    "jitter": "delay=9,jitter=8",
    "fast": "rate=700,delay=1",
    "slow": "rate=1,delay=100",
}


@pytest.mark.parametrize("name", [*LINKS])
def test_a_link_that_carries_its_profile_is_found_to(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ways = load_link(LINKS[name]).directions()
    found = quantities(monkeypatch, ways, ways)
    assert not [str(each) for each in found.values() if each.off]
    rates = {"rate up": ways[0].mbps, "rate down": ways[1].mbps}
    for what, mbps in rates.items():
        assert (what in found) == math.isfinite(mbps)
        if what in found:
            assert (found[what].measured, found[what].profile) == (pytest.approx(mbps, rel=0.006), mbps)
            assert found[what].tolerance == pytest.approx(0.05 * mbps)
    delay, usual_ms = found["added one-way delay"], sum(way.usual_ms for way in ways) / 2
    at_rate_ms = sum(128 * 8e-3 / (way.burst_mbps if way.burst_bytes else way.mbps) for way in ways) / 2
    jitter_ms = 3 * 8 / math.sqrt(12 * 2 * room.PINGS) if name == "jitter" else 0.01
    assert delay.profile == pytest.approx(usual_ms + at_rate_ms)
    assert delay.tolerance == pytest.approx(0.3 + 0.05 * delay.profile)
    assert delay.measured == pytest.approx(delay.profile - LOCAL_MS, abs=jitter_ms)
    for what, way in (("loss up", ways[0]), ("loss down", ways[1])):
        spread = math.sqrt(way.loss * (1 - way.loss) / 2000)
        assert found[what].measured == pytest.approx(way.loss, abs=4 * spread)
        assert found[what].tolerance == pytest.approx(4 * spread + 0.002)
    assert ("burst up" in found) == ("burst" in name)
    if "burst" in name:
        assert found["burst down"].measured == pytest.approx(ways[1].burst_mbps, rel=0.01)
        assert found["burst down"].tolerance == pytest.approx(0.05 * ways[1].burst_mbps)


@pytest.mark.parametrize(
    ("link", "carried", "off"),
    [
        ("rate=20/60,delay=5", "rate=18.5/60,delay=5", ["rate up"]),
        ("rate=20/60,delay=5", "rate=20/64,delay=5", ["rate down"]),
        ("rate=20,delay=5", "rate=20,delay=5.7", ["added one-way delay"]),
        ("delay=20", "delay=18.5", ["added one-way delay"]),
        ("rate=40,loss=10%", "rate=40,loss=14%", ["loss up", "loss down"]),
        ("rate=40", "rate=40,loss=1%", ["loss up", "rate up", "loss down", "rate down"]),
        (LINKS["burst"], "rate=20,burst_kib=150,burst_mbps=50", ["burst up", "burst down"]),
        (LINKS["burst"], "rate=20,burst_kib=60,burst_mbps=60", ["burst up", "burst down"]),
    ],
)
def test_what_a_link_does_not_carry_is_off(
    link: str, carried: str, off: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = quantities(monkeypatch, load_link(link).directions(), load_link(carried).directions())
    assert [what for what, each in found.items() if each.off] == off


def test_a_link_that_carries_nothing_is_off_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = load_link("rate=20,delay=5").directions()
    none = tuple(replace(way, loss=1.0) for way in ways)
    found = quantities(monkeypatch, ways, none)  # type: ignore[arg-type]
    assert {what: each.measured for what, each in found.items()} == {
        "loss up": 1, "rate up": 0, "loss down": 1, "rate down": 0,
    }  # fmt: skip
    assert all(each.off for each in found.values())
    assert str(found["loss up"]) == "loss up 1 instead of 0"


def test_a_trace_is_not_checked_and_an_attempt_is_repeated_until_nothing_is_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    changing = Direction(1, steps=(Step(0, 1, 0, 0),), period_s=1)
    for ways in ((changing, Direction(1)), (Direction(1), changing)):
        assert quantities(monkeypatch, ways, ways) == {}
    good, bad = Measurement("rate up", "Mbit/s", 100, 95, 5), Measurement("rate up", "Mbit/s", 100, 94.9, 5)
    assert (good.off, bad.off, replace(good, measured=105.1).off, replace(good, measured=math.nan).off) == (0, 1, 1, 1)
    attempts = iter([[bad], [good, bad], [good]])
    monkeypatch.setattr(room._Probe, "measure", lambda _: iter(next(attempts)))
    net = Net(Direction(1), Direction(1))
    link: Any = Link(net, net.directions)
    entry = probed(link)["probe"]
    assert entry["attempts"] == 3
    assert [each["measured"] for each in entry["quantities"]] == [95]
    attempts = iter([[bad]] * 3)
    with pytest.raises(UsageError, match=r"within 5%: rate up 94\.9 instead of 100 Mbit/s; stop other programs"):
        probed(link)
    assert next(attempts, None) is None
