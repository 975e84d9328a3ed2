"""Floods and overfull documents: what they cost a server, beside a twin that nobody attacks.

Honest requests go to both in turn for as long as an attack lasts. How long they waited is printed (their ratio); that
each was answered, the reply to the attacker, and the memory above the twin's are judged.
"""

from __future__ import annotations

import resource
import socket
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from threading import Thread
from typing import Any

import pytest

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.testing.transport import wiring_of
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.transport.http.native import PATHS
from tests.hostile.asking import forget_peak, usage
from tests.hostile.suite import Attack, honest_answer, own_server
from tests.hostile.tcp import RESET, connect, crowd, sends, sends_made
from tests.hostile.wires import websocket, zmq
from tests.hostile.wires.http import CHUNKS, JSON, chat, head, post

ROUNDS = 20
"""Honest requests to each server, at least; more while the attack lasts."""
MORE_MIB = 256.0
MIB = 1 << 20


@dataclass(frozen=True)
class Flood:
    """One attack, and the one line of its refusal."""

    name: str
    pipeline: str
    does: Attack
    says: str


def lasting(attack: Attack, seconds: float = 5.0) -> Attack:
    """Return an attack that begins again until the time is over."""

    def again(wiring: Wiring[Any]) -> str:
        ends_ns, reply = now_ns() + round(seconds * 1e9), ""
        while now_ns() < ends_ns:
            reply = attack(wiring)
        return reply

    return again


def leaves_unread(path: str) -> Attack:
    """Return clients that ask, send 200 KB more behind their request, and go without an answer."""

    def attack(wiring: Wiring[Any]) -> str:
        for _ in range(3):
            with connect(wiring, 10) as connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
                connection.sendall(chat(fields='"stream": true, "max_tokens": 60000', path=path))
                connection.sendall(bytes(200_000))
                SystemClock().sleep_until_ns(now_ns() + 300_000_000)
                connection.shutdown(socket.SHUT_WR)
        return ""

    return attack


def lists(mib: int, path: str) -> Attack:
    """Return a client whose messages are empty lists."""
    return sends_made(lambda: [post(b'{"messages": [' + b"[]," * (mib * MIB // 3) + b"[]]}", path=path)], seconds=20)


def numbers(path: str) -> Attack:
    return sends_made(lambda: [post(b'{"messages": [' + b"0, " * (19 * MIB) + b"0]}", path=path)], seconds=20)


def chunks(path: str) -> Attack:
    """Return a client that sends a body in chunks of 2 bytes."""
    return sends_made(
        lambda: [head(JSON, CHUNKS, path=path), *[b"2\r\n[,\r\n" * (1 << 16)] * 3, b"0\r\n\r\n"], seconds=20
    )


def headers(path: str) -> Attack:
    """Return 2000 clients at once that send 64 KiB of empty headers each."""
    return crowd(2000, sends(head(path=path)[:-2] + b"a:\r\n" * 16_000 + b"\r\n", seconds=20))


def frames() -> Iterable[bytes]:
    return [zmq.ready(b"DEALER"), zmq.short(b"", more=True) * 4_000_000, zmq.short(b"")]


VALUES = "more than 20000 values"
OVER_HTTP: Sequence[tuple[str, Callable[[str], Attack], str]] = (
    ("4 MiB of empty lists", lambda path: lists(4, path), VALUES),
    ("57 MiB of empty lists", lambda path: lists(57, path), VALUES),
    ("19 million numbers", numbers, VALUES),
    ("chunks of 2 bytes", chunks, f"Content-Length|{VALUES}"),
    ("64 KiB of headers on 2000 connections", headers, "lines of headers|connections are open"),
    ("200 KB behind a request", leaves_unread, ""),
)
FLOODS = (
    *(
        Flood(f"{variant}: {name}", f"http/{variant}", flood(PATHS[variant]), says)
        for variant in ("as-deployed", "best-effort")
        for name, flood, says in OVER_HTTP
    ),
    *(Flood(name, "websocket/openpi", lasting(flood), websocket.FLOOD) for name, flood in websocket.FLOODS.items()),
    Flood(
        "4 million empty frames",
        "zmq/gr00t",
        sends_made(frames, seconds=30, first=len(zmq.GREETING)),
        "a request is one frame",
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize("flood", FLOODS, ids=[flood.name for flood in FLOODS])
def test_honest_clients_are_answered_beside_it(
    flood: Flood, tmp_path: Path, record_property: Callable[[str, object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    wiring = wiring_of(flood.pipeline, timeout_s=60)
    with ExitStack() as stack:
        servers = [stack.enter_context(own_server(wiring, tmp_path / name)) for name in ("attacked", "twin")]
        honest = [stack.enter_context(closing(open_client(replace(wiring, address=each.address)))) for each in servers]
        expected = [honest_answer(client) for client in honest]
        for server in servers:
            forget_peak(server.pid)
        replies: list[str] = []
        attacker = Thread(target=lambda: replies.append(flood.does(replace(wiring, address=servers[0].address))))
        attacker.start()
        waits: list[tuple[float, float]] = []
        while attacker.is_alive() or len(waits) < ROUNDS:
            waited, answers = zip(*map(timed, honest), strict=True)
            assert [*answers] == expected
            waits.append(waited)
        attacker.join()
        attacked, quiet = zip(*waits, strict=True)
        peak, calm = (usage(server.pid).peak_mib for server in servers)
        line = (
            f"{flood.name}: {len(waits)} requests waited {median(attacked) / median(quiet):.2f} x the twin's, "
            f"{max(attacked):.2f} s at most ({max(quiet):.2f} s); {peak - calm:+.0f} MiB"
        )
        record_property("cost", line)
        with capsys.disabled():
            sys.stdout.write(f"\n{line}\n")
        assert all(server.alive() for server in servers)
        assert "Traceback" not in (tmp_path / "attacked").read_text()
        assert any(word in replies[0] for word in flood.says.split("|")), replies[0][-1000:]
        assert peak - calm <= (MORE_MIB if flood.pipeline != "zmq/gr00t" else 1024), line


def timed(client: Client) -> tuple[float, list[str]]:
    began = now_ns()
    answer = honest_answer(client)
    return (now_ns() - began) / 1e9, answer


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort"])
def test_out_of_descriptors_those_that_are_connected_are_answered(variant: str, tmp_path: Path) -> None:
    wiring = wiring_of(f"http/{variant}")
    with own_server(wiring, tmp_path / "log") as server, ExitStack() as stack:
        here = replace(wiring, address=server.address)
        client = stack.enter_context(closing(open_client(here)))
        expected = honest_answer(client)
        limits = resource.prlimit(server.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (usage(server.pid).descriptors + 3, limits[1]))
        for _ in range(20):
            stack.enter_context(connect(here, 60))
        time.sleep(0.5)
        assert honest_answer(client) == expected
        resource.prlimit(server.pid, resource.RLIMIT_NOFILE, limits)
        assert sends(chat(path=PATHS[variant]), seconds=10)(here).startswith("HTTP/1.1 200 ")
    assert "Traceback" not in (tmp_path / "log").read_text()
