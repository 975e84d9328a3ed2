"""Connections of a server: a silence ends a read, and writes never wait."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from functools import partial
from threading import Thread

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.transport.connections import Wire, wait_at_most
from s2a_bench.transport.serving import Disconnected
from tests.waiting import until

LARGE = bytes(64 << 20)


@pytest.fixture
def ends() -> Iterator[tuple[Wire, socket.socket]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = socket.create_connection(listener.getsockname())
        accepted, _ = listener.accept()
        with client, accepted:
            yield Wire(accepted), client


def test_a_silence_ends(ends: tuple[Wire, socket.socket]) -> None:
    wire, client = ends
    wait_at_most(wire.socket, 0.05)
    with pytest.raises(BlockingIOError):
        wire.socket.recv(1)
    wait_at_most(wire.socket, 0)
    client.sendall(b"a")
    assert wire.socket.recv(1) == b"a"


def test_a_write_never_waits_whatever_silence_reads_may_have(ends: tuple[Wire, socket.socket]) -> None:
    wire, client = ends
    wait_at_most(wire.socket, 40)
    began = now_ns()
    for _ in range(1 << 16):
        wire.sendall(LARGE[:1024])
    wire.sendall(b"the end")
    assert now_ns() - began < 20e9  # of the silence's 40
    heard = bytearray()
    reading = Thread(target=lambda: heard.extend(b"".join(iter(partial(client.recv, 1 << 20), b""))))
    reading.start()
    wire.flush(60)
    wire.hang_up()
    reading.join()
    assert len(heard) == len(LARGE) + 7
    assert heard.endswith(b"the end")


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
    until(wire.disconnected)
    assert len(wire.socket.recv(1000)) == 1000
