"""The relay: every byte, in both directions, whatever clients, servers and readers do."""

from __future__ import annotations

import hashlib
import os
import socket
import ssl
import struct
import subprocess
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from time import sleep

import pytest

from s2a_bench.clock import now_ns
from s2a_bench.plugins.watch.relay import MOST_HELD, ByteRelay, Passed
from s2a_bench.transport.limits import LIMITS
from s2a_bench.transport.tap import Seen, TapReader, TurnsReader
from tests.waiting import until

RESET = struct.pack("ii", 1, 0)


@contextmanager
def server(answer: Callable[[socket.socket], None]) -> Iterator[tuple[str, int]]:
    """Serve each connection by a thread of its own."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def handle(connection: socket.socket) -> None:
            with connection, suppress(OSError):
                answer(connection)

        def accept() -> None:
            with suppress(OSError):
                while True:
                    Thread(target=handle, args=(listener.accept()[0],), daemon=True).start()

        Thread(target=accept, daemon=True).start()
        yield listener.getsockname()
        listener.shutdown(socket.SHUT_RDWR)


class Tap:
    """A relay that runs, with all that it tells."""

    def __init__(self, at: tuple[str, int], reader: type[TapReader] = TurnsReader) -> None:
        self.seen: list[tuple[int, Seen]] = []
        self.said: list[str] = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = self.listener.getsockname()
        report = lambda client, seen: self.seen.append((client, seen))  # noqa: E731
        self.relay = ByteRelay(self.listener, at, reader, report, self.said.append)
        self.thread = Thread(target=self.relay.serve, daemon=True)
        self.thread.start()

    def __enter__(self) -> Tap:  # noqa: PYI034 - Self is typing's since 3.11
        return self

    def __exit__(self, *_: object) -> None:
        self.relay.stop()
        self.thread.join()
        self.listener.close()


def exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(size - len(data))):
        data += more
    return data


def everything(connection: socket.socket) -> str:
    """Return the SHA-256 of what comes until the end."""
    whole = hashlib.sha256()
    while data := connection.recv(1 << 16):
        whole.update(data)
    return whole.hexdigest()


def echo(connection: socket.socket) -> None:
    while data := connection.recv(1 << 16):
        connection.sendall(data)


def double(connection: socket.socket) -> None:
    """Answer each 1000 bytes with 2000."""
    while len(data := exactly(connection, 1000)) == 1000:
        connection.sendall(data * 2)


def test_a_half_closed_client_gets_the_whole_answer() -> None:
    data = os.urandom(3 << 20)
    received: list[str] = []

    def answer(connection: socket.socket) -> None:
        received.append(everything(connection))  # until the client has closed its half
        connection.sendall(data[::-1])

    with server(answer) as at, Tap(at) as tap, socket.create_connection(tap.address) as client:
        client.sendall(data)
        client.shutdown(socket.SHUT_WR)
        assert everything(client) == hashlib.sha256(data[::-1]).hexdigest()
        until(lambda: tap.seen)
    assert received == [hashlib.sha256(data).hexdigest()]
    ((_, seen),) = tap.seen
    assert (seen.up_bytes, seen.down_bytes, seen.error) == (len(data), len(data), "")
    assert seen.request_ns < seen.sent_ns <= seen.answer_ns < seen.end_ns


def test_a_half_closed_server_still_reads() -> None:
    received: list[bytes] = []

    def answer(connection: socket.socket) -> None:
        connection.sendall(b"all that I say")
        connection.shutdown(socket.SHUT_WR)
        received.append(exactly(connection, 1 << 20))

    with server(answer) as at, Tap(at) as tap, socket.create_connection(tap.address) as client:
        assert everything(client) == hashlib.sha256(b"all that I say").hexdigest()
        client.sendall(b"x" * (1 << 20))
        until(lambda: received)
    assert received == [b"x" * (1 << 20)]


def test_single_bytes_and_turns() -> None:
    with server(double) as at, Tap(at) as tap, socket.create_connection(tap.address) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for _ in range(3):
            for _ in range(1000):
                client.sendall(b"a")
            assert exactly(client, 2000) == b"a" * 2000
        client.close()
        until(lambda: len(tap.seen) == 3)
    assert {(client, seen.what, seen.up_bytes, seen.down_bytes) for client, seen in tap.seen} == {
        (0, "turns", 1000, 2000)
    }


def test_both_directions_at_once_with_a_client_that_does_not_read() -> None:
    """What is not read waits in sockets: no more than a few parts are held, and no direction stops the other."""
    data = os.urandom(4 << 20)
    got: list[str] = []

    def answer(connection: socket.socket) -> None:
        sending = Thread(target=connection.sendall, args=(data * 4,))
        sending.start()
        got.append(hashlib.sha256(exactly(connection, len(data))).hexdigest())
        sending.join()

    with server(answer) as at, Tap(at) as tap, socket.create_connection(tap.address) as client:
        client.sendall(data)  # while the other direction is full
        until(lambda: got)
        assert got == [hashlib.sha256(data).hexdigest()]
        assert hashlib.sha256(exactly(client, 4 * len(data))).hexdigest() == hashlib.sha256(data * 4).hexdigest()


def test_tls_passes_and_is_read_by_who_speaks(tmp_path: Path) -> None:
    key, cert = tmp_path / "key.pem", tmp_path / "cert.pem"
    command = f"openssl req -x509 -newkey rsa:2048 -nodes -keyout {key} -out {cert} -days 1 -subj /CN=localhost"
    subprocess.run([*command.split(), "-addext", "subjectAltName=DNS:localhost"], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(cert, key)

    def answer(connection: socket.socket) -> None:
        with context.wrap_socket(connection, server_side=True) as wrapped:
            while data := wrapped.recv(1 << 16):
                wrapped.sendall(data)

    trusting = ssl.create_default_context(cafile=str(cert))
    with server(answer) as at, Tap(at) as tap, socket.create_connection(tap.address) as plain:
        with trusting.wrap_socket(plain, server_hostname="localhost") as client:
            client.sendall(b"secret")
            assert client.recv(100) == b"secret"
        until(lambda: tap.seen)
    assert all(seen.up_bytes for _, seen in tap.seen)


@pytest.mark.parametrize("how", [RESET, b""])
@pytest.mark.parametrize("who", ["client", "server"])
def test_an_end_in_the_middle_ends_the_other_side_and_is_told(how: bytes, who: str) -> None:
    asked, ended = Event(), Event()

    def answer(connection: socket.socket) -> None:
        exactly(connection, 1000)
        asked.set()
        if who == "server":
            kill(connection)
        else:
            everything(connection)
            ended.set()

    def kill(connection: socket.socket) -> None:
        if how:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, how)
        connection.close()

    with server(answer) as at, Tap(at) as tap, socket.create_connection(tap.address) as client:
        client.sendall(b"x" * 1000)
        assert asked.wait(20)
        if who == "client":
            kill(client)
            assert ended.wait(20)
        else:
            with suppress(ConnectionError):
                assert client.recv(10) == b""
            client.close()
        until(lambda: tap.seen)
    ((_, seen),) = tap.seen
    assert "ended before" in seen.error
    assert seen.up_bytes == 1000


def test_a_server_that_is_not_there_is_said_once_and_may_come() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        at = free.getsockname()
    with Tap(at) as tap:
        for _ in range(3):
            with socket.create_connection(tap.address) as client, suppress(ConnectionError):
                assert client.recv(1) == b""
        until(lambda: tap.relay.totals.unreachable == 3)
        assert len(tap.said) == 1
        assert f"nothing answers at 127.0.0.1:{at[1]}" in tap.said[0]


def test_a_client_that_connects_again_is_the_same_client() -> None:
    with server(double) as at, Tap(at) as tap:
        for _ in range(3):
            with socket.create_connection(tap.address) as client:
                client.sendall(b"a" * 1000)
                exactly(client, 2000)
        with socket.create_connection(tap.address) as one, socket.create_connection(tap.address) as other:
            for each in (one, other):
                each.sendall(b"a" * 1000)
                exactly(each, 2000)
        until(lambda: len(tap.seen) == 5)
    assert sorted(client for client, _ in tap.seen) == [0, 0, 0, 0, 1]
    assert (tap.relay.totals.connections, tap.relay.totals.reconnects) == (5, 3)


def test_connections_are_bounded() -> None:
    with server(echo) as at, Tap(at) as tap, ExitStack() as stack:
        clients = [stack.enter_context(socket.create_connection(tap.address)) for _ in range(LIMITS.connections + 1)]
        for client in clients[:-1]:
            client.sendall(b"x")
            assert client.recv(1) == b"x"
        with suppress(ConnectionError):
            assert clients[-1].recv(1) == b""


class Failing(TapReader):
    """Fails at the second part that goes up."""

    parts = 0

    def up(self, data: bytes) -> None:
        self.parts += 1
        if self.parts > 1:
            raise RecursionError(f"{len(data)} bytes too much")

    def down(self, data: bytes) -> None: ...


def test_a_reader_that_fails_is_replaced_and_nobody_notices() -> None:
    with server(double) as at, Tap(at, Failing) as tap:
        for _ in range(2):
            with socket.create_connection(tap.address) as client:
                for _ in range(4):
                    client.sendall(b"a" * 1000)
                    assert len(exactly(client, 2000)) == 2000
        until(lambda: len(tap.seen) == 6)
    assert tap.relay.totals.unread == 2
    assert tap.said == [
        "what passes is not what was expected (1000 bytes too much); such connections are read by turns"
    ]


def test_parts_are_read_in_the_order_in_which_they_came() -> None:
    """An answer that is passed on before its request's thread goes on is an answer to it all the same."""
    seen: list[Seen] = []
    passed = Passed(TurnsReader(seen.append, set()), lambda _: None)
    request = passed.arrived(b"question", up=True)
    answer = passed.arrived(b"answer", up=False)
    answer.to_ns = now_ns()
    passed.read()
    assert not passed.reader._waiting
    request.to_ns = now_ns()
    passed.read()
    passed.end()
    assert [(each.up_bytes, each.down_bytes, each.error) for each in seen] == [(8, 6, "")]


def test_a_part_that_is_not_taken_does_not_hold_the_others_for_ever() -> None:
    seen: list[Seen] = []
    passed = Passed(TurnsReader(seen.append, set()), lambda _: None)
    passed.arrived(b"question", up=True)  # its receiver does not read
    for _ in range(MOST_HELD + 10):
        passed.arrived(b"x", up=False).to_ns = now_ns()
        passed.read()
    assert len(passed._parts) <= MOST_HELD


def test_ten_thousand_exchanges_do_not_grow() -> None:
    with server(double) as at, Tap(at) as tap, socket.create_connection(tap.address) as client:

        def some(count: int) -> int:
            for _ in range(count):
                client.sendall(b"a" * 1000)
                exactly(client, 2000)
            sleep(0.01)
            tap.seen.clear()
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            before, after = some(200), some(5000)
        finally:
            tracemalloc.stop()
    assert after - before < 600_000  # two buffers, where an exchange that stays would make megabytes
