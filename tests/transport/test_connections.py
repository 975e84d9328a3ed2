"""Connections of a server: reads have a deadline, writes never wait, departures are noticed behind unread bytes."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from threading import Thread

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.transport.connections import Wire
from s2a_bench.transport.serving import Disconnected

LARGE = bytes(64 << 20)


@pytest.fixture
def ends() -> Iterator[tuple[Wire, socket.socket]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = socket.create_connection(listener.getsockname())
        accepted, _ = listener.accept()
        with client, accepted:
            yield Wire(accepted), client


def test_a_read_ends_at_its_deadline(ends: tuple[Wire, socket.socket]) -> None:
    wire, client = ends
    wire.read_until(now_ns() + 50_000_000)
    with pytest.raises(TimeoutError):
        wire.recv(1)
    with pytest.raises(TimeoutError):  # it is over already
        wire.recv(1)
    wire.read_until(0)
    client.sendall(b"a")
    assert wire.recv(1) == b"a"


def test_a_write_never_waits_whatever_deadline_reads_have(ends: tuple[Wire, socket.socket]) -> None:
    wire, client = ends
    wire.read_until(now_ns() + 40 * 10**9)
    client.sendall(b"a")
    assert wire.recv(1) == b"a"
    began = now_ns()
    for _ in range(1 << 16):
        wire.sendall(LARGE[:1024])
    wire.sendall(b"the end")
    assert now_ns() - began < 20e9  # of the deadline's 40
    heard = bytearray()
    reading = Thread(target=lambda: heard.extend(iter_all(client)))
    reading.start()
    wire.flush(60)
    wire.hang_up()
    reading.join()
    assert len(heard) == len(LARGE) + 7
    assert heard.endswith(b"the end")


def iter_all(client: socket.socket) -> bytes:
    data = bytearray()
    while piece := client.recv(1 << 20):
        data += piece
    return bytes(data)


def test_a_client_that_does_not_read_is_given_up_in_time(ends: tuple[Wire, socket.socket]) -> None:
    wire, _ = ends
    wire.sendall(LARGE)
    with pytest.raises(Disconnected, match="does not read"):
        wire.flush(0.05)


def test_a_client_that_has_gone_is_noticed_while_its_bytes_lie_unread(ends: tuple[Wire, socket.socket]) -> None:
    wire, client = ends
    client.sendall(bytes(1000))
    assert not wire.disconnected()
    client.close()
    ends_ns = now_ns() + 10 * 10**9
    while not wire.disconnected() and now_ns() < ends_ns:
        pass
    assert wire.disconnected()
