"""When the relay of a link delivers each packet: in virtual time."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from statistics import mean

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.plugins.two_hosts.links import relay as room
from s2a_bench.plugins.two_hosts.links.relay import Relay, Shaper
from s2a_bench.plugins.two_hosts.profiles import Direction, Step


def test_packets_queue_for_the_rate_and_then_take_the_delay() -> None:
    shaper = Shaper(Direction(12.0, delay_ms=5))  # 1,500 bytes a ms
    assert [shaper.due_s(0.0, 1500) for _ in range(3)] == pytest.approx([0.006, 0.007, 0.008])
    assert shaper.due_s(1.0, 750) == pytest.approx(1.0055)


def test_a_burst_after_idle_is_fast_and_its_credit_grows_at_the_rate() -> None:
    shaper = Shaper(Direction(12.0, burst_bytes=3000, burst_mbps=120))
    assert [shaper.due_s(0.0, 1500) for _ in range(3)] == pytest.approx([0.0001, 0.0002, 0.0012])
    assert shaper.due_s(0.0022, 1500) == pytest.approx(0.0023)  # idle for 1 ms: one packet's credit
    assert shaper.due_s(0.0023, 1500) == pytest.approx(0.0033)


@given(
    st.lists(st.tuples(st.sampled_from([0] * 20 + [30_000]), st.integers(500, 1500)), min_size=2, max_size=80),
    st.integers(1500, 9000),
)
def test_a_link_is_a_token_bucket(packets: list[tuple[int, int]], burst: int) -> None:
    """However long it was idle: between any two packets arrive no more bytes than the burst and what the rate gives."""
    way = Direction(12.0, delay_ms=3, burst_bytes=burst, burst_mbps=1e6, queue_ms=60_000)
    shaper, now_s, arrived = Shaper(way), 0.0, list[tuple[float, int]]()
    for idle_us, size in packets:
        now_s += idle_us / 1e6
        due_s = shaper.due_s(now_s, size)
        assert due_s - now_s >= way.least_s(size) - 1e-9
        arrived.append((due_s, size))
    for first, (start_s, _) in enumerate(arrived):
        total = 0
        for due_s, size in arrived[first:]:
            total += size
            assert total <= burst + (due_s - start_s) * 12e6 / 8 + 1500


def test_what_waits_longer_than_the_queue_is_dropped() -> None:
    shaper = Shaper(Direction(12.0, queue_ms=2))
    assert [shaper.due_s(0.0, 1500) is None for _ in range(4)] == [False, False, False, True]
    assert (shaper.dropped, shaper.lost) == (1, 0)


def test_lost_packets_take_none_of_the_rate_and_are_lost_again_with_the_same_seed() -> None:
    shapers = [Shaper(Direction(12.0, loss=0.2, seed=7, queue_ms=60_000)) for _ in range(2)]
    first, again = ([shaper.due_s(0.0, 1500) for _ in range(5000)] for shaper in shapers)
    assert first == again
    arrived = [due for due in first if due is not None]
    assert 1 - len(arrived) / 5000 == pytest.approx(0.2, abs=0.02)
    assert arrived[-1] == pytest.approx(len(arrived) * 0.001)


def test_jitter_is_added_and_packets_keep_their_order() -> None:
    shaper = Shaper(Direction(1e6, delay_ms=10, jitter_ms=4, seed=1))
    spaced = [(shaper.due_s(second, 100) or 0) - second for second in range(1000)]
    assert 0.01 <= min(spaced) < 0.0101
    assert 0.0139 < max(spaced) <= 0.01401
    assert mean(spaced) == pytest.approx(0.012, abs=0.0002)
    assert Direction(1e6, delay_ms=10, jitter_ms=4).usual_ms == 12
    dues = [shaper.due_s(2000 + number / 1e4, 100) or 0 for number in range(1000)]
    assert dues == sorted(dues)


def test_a_trace_carries_the_bytes_of_its_steps_and_asks_for_nothing_in_an_outage() -> None:
    """Counted by hand over two periods: 1,500 bytes a ms for 2.2 ms, an outage until 5 ms, then 3,000 bytes a ms."""
    steps = (Step(0.0, 12.0, 2.0, 0.0), Step(0.0022, 0.0, 1.0, 0.0), Step(0.005, 24.0, 0.0, 0.0))
    shaper = Shaper(Direction(24.0, steps=steps, period_s=0.01, queue_ms=1e6))
    left_ms = [1, 2, *(5.4 + each / 2 for each in range(10)), 10.8, 11.8, *(15.3 + each / 2 for each in range(10))]
    dues_ms = [1e3 * (shaper.due_s(0.0, 1500) or 0) for _ in left_ms]
    assert dues_ms == pytest.approx([each + 2 for each in left_ms], abs=1e-4)
    late = Shaper(Direction(24.0, steps=steps, period_s=0.01, queue_ms=1e6))
    assert late.due_s(0.0025, 3000) == pytest.approx(0.006 + 0.001, abs=1e-6)
    assert late.due_s(1.008, 1500) == pytest.approx(1.0085, abs=1e-6)
    lossy = Shaper(Direction(24.0, steps=(Step(0.0, 12.0, 0.0, 0.0), Step(0.009, 12.0, 0.0, 1.0)), period_s=0.01))
    assert (lossy.due_s(0.0, 1500), lossy.due_s(0.0195, 1500)) == (pytest.approx(0.001, abs=1e-6), None)


class Devices:
    """Pairs of sockets as a relay's two devices, in virtual time; ``sends`` are (ms, sending side, packet)."""

    def __init__(self, stack: ExitStack, patch: pytest.MonkeyPatch, sends: list[tuple[float, int, bytes]]) -> None:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(3)]
        for each in (each for pair in pairs for each in pair):
            stack.enter_context(each).setblocking(False)
        (self.client, client), (self.server, server), (self.control, control) = pairs
        self.ns, self._sends, self._end = 10**9, sorted(sends), control.fileno()
        self.seen: list[tuple[float, str, bytes]] = []
        patch.setattr(room, "now_ns", lambda: self.ns)
        patch.setattr(room, "select", self.select)
        self.devices = [client.fileno(), server.fileno()]

    def select(
        self, readers: list[int], _: object, __: object, wait_s: float | None
    ) -> tuple[list[int], list[int], list[int]]:
        """Keep what was delivered, then go to the next packet that is sent, or is due."""
        assert readers == [*self.devices, self._end]
        for name, end in (("client", self.client), ("server", self.server)):
            while True:
                try:
                    self.seen.append(((self.ns - 10**9) / 1e6, name, end.recv(4096)))
                except BlockingIOError:
                    break
        next_ns = 10**9 + round(1e6 * self._sends[0][0]) if self._sends else None
        if wait_s is not None and (next_ns is None or self.ns + wait_s * 1e9 < next_ns):
            self.ns += max(1, round(wait_s * 1e9))
            return [], [], []
        if next_ns is None:
            return [self._end], [], []
        self.ns = next_ns
        at_ms, side, _ = self._sends[0]
        while self._sends and self._sends[0][:2] == (at_ms, side):
            (self.client, self.server)[side].send(self._sends.pop(0)[2])
        return [self.devices[side]], [], []


def packet(number: int, size: int = 1500, version: int = 4) -> bytes:
    return bytes([version << 4 | 5, number]) + bytes(size - 2)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


def test_the_relay_delivers_each_packet_to_the_other_side_when_it_is_due(
    stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    sends = [(0.0, 0, packet(1)), (0.0, 0, packet(2)), (0.5, 1, packet(3)), (1.0, 1, packet(4, version=6))]
    sends += [(30.0, 0, packet(5, 750))]
    made = Devices(stack, monkeypatch, sends)
    up, down = Direction(12.0, delay_ms=5), Direction(24.0, delay_ms=1)
    relay = Relay(made.devices, [asdict(up), asdict(down)])
    assert relay.facts()["late_ms"] == {"median": 0.0, "p99": 0.0}
    relay.run_until(made._end)
    assert [(name, data[1]) for _, name, data in made.seen] == [
        ("client", 3),
        ("server", 1),
        ("server", 2),
        ("server", 5),
    ]
    assert [at_ms for at_ms, _, _ in made.seen] == pytest.approx([2, 6, 7, 35.5], abs=1e-4)
    assert [len(data) for _, _, data in made.seen] == [1500, 1500, 1500, 750]
    facts = relay.facts()
    assert (facts["packets"], facts["lost"], facts["dropped"]) == (4, 0, 0)
    assert 0 <= facts["late_ms"]["median"] <= facts["late_ms"]["p99"] < 1e-3


def test_the_relay_counts_what_was_lost_dropped_and_late(stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Devices(stack, monkeypatch, [(0.0, 0, packet(each)) for each in range(9)])
    relay = Relay(made.devices, [asdict(Direction(12.0, queue_ms=3.5)), asdict(Direction(12.0, loss=0.999))])
    made._sends += [(1.0, 1, packet(9))]
    relay.run_until(made._end)
    assert [data[1] for _, _, data in made.seen] == [0, 1, 2, 3]
    facts = relay.facts()
    assert (facts["packets"], facts["lost"], facts["dropped"]) == (4, 1, 5)
    relay._late_s.extend([0.001] * 94 + [0.5])
    assert relay.facts()["late_ms"] == {"median": 1, "p99": 500}
    held = Relay(made.devices, [asdict(Direction(12.0)), asdict(Direction(12.0))])
    monkeypatch.setattr(room, "MOST_HELD", 2)
    made._sends, made.seen = [(9.0, 0, packet(each)) for each in range(4)], []
    held.run_until(made._end)
    assert [data[1] for _, _, data in made.seen] == [0, 1]


def test_one_device_has_its_turn_while_the_other_sends_without_end(
    stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most some packets are read at once, then what is due is delivered."""
    made = Devices(stack, monkeypatch, [])
    relay = Relay(made.devices, [asdict(Direction(float("inf")))] * 2)
    for each in range(room.AT_ONCE + 6):
        made.client.send(packet(each))
    relay._take(made.devices[0])
    assert relay.facts()["packets"] == room.AT_ONCE
    relay._take(made.devices[0])
    assert relay.facts()["packets"] == room.AT_ONCE + 6


def test_the_program_carries_packets_in_its_order_and_ends_with_its_input() -> None:
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
    (client, one), (server, two) = pairs
    ways = [asdict(Direction(float("inf"), delay_ms=3)), asdict(Direction(float("inf"), delay_ms=2))]
    with client, server, one, two:
        devices = [one.fileno(), two.fileno()]
        with subprocess.Popen(
            [sys.executable, "-m", "s2a_bench.plugins.two_hosts.links.relay"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=devices, text=True,
        ) as program:  # fmt: skip
            program.stdin.write(json.dumps({"devices": devices, "directions": ways}) + "\n")
            program.stdin.flush()
            assert json.loads(program.stdout.readline()) == {"address": ""}
            for way in ((client, server), (server, client)):
                for each in (1, 2):
                    way[0].send(packet(each))
                assert [way[1].recv(2048)[1] for _ in range(2)] == [1, 2]
            for _ in range(2):
                program.stdin.write("\n")
                program.stdin.flush()
                facts = json.loads(program.stdout.readline())
                assert (facts["packets"], facts["lost"], facts["dropped"]) == (4, 0, 0)
                assert facts["late_ms"]["median"] >= 0
            program.stdin.close()
            assert program.wait(60) == 0
