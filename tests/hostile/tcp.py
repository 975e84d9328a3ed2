"""Hostile peers for any transport over TCP, without knowledge of its messages, and functions that build others."""

from __future__ import annotations

import random
import socket
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from threading import Event, Thread
from typing import Any, Literal, TypeAlias

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.transport import Wiring
from tests.hostile.suite import FAILED, Attack, Case, Trap

Then: TypeAlias = Literal["waits", "goes", "resets"]
"""A peer's last act: it reads until the other side closes, closes in order, or resets the connection."""
Block: TypeAlias = "bytes | Callable[[bytes], bytes]"
"""Bytes, or a function that makes them from the first bytes received."""
GIB = 1 << 30
NOISE = random.Random(1).randbytes(1 << 16)
ENDLESS = [bytes(1 << 16)] * (1 << 16)
"""4 GiB."""
RESET = struct.pack("ii", 1, 0)
REPLY_BYTES = 1 << 20


def connect(wiring: Wiring[Any], seconds: float) -> socket.socket:
    host, _, port = wiring.address.rpartition("//")[2].partition("/")[0].rpartition(":")
    return socket.create_connection((host, int(port)), timeout=seconds)


def sends(*pieces: bytes, **more: Any) -> Attack:
    """Return a client like that of `sends_made`, with constant pieces."""
    return sends_made(lambda: pieces, **more)


def sends_made(
    make: Callable[[], Iterable[bytes]],
    *,
    then: Then = "waits",
    seconds: float = 2.0,
    every_s: float = 0.0,
    first: int = 0,
) -> Attack:
    """Return a client that sends pieces, one each ``every_s``, and then reads for ``seconds`` at most.

    After its first piece it waits for ``first`` bytes.
    """

    def attack(wiring: Wiring[Any]) -> str:
        reply, clock = b"", SystemClock()
        with connect(wiring, seconds) as connection:
            with suppress(OSError):  # the server refuses the rest
                for piece in make():
                    connection.sendall(piece)
                    while len(reply) < first and (received := connection.recv(1 << 16)):
                        reply += received
                    if every_s:
                        clock.sleep_until_ns(now_ns() + round(every_s * 1e9))
            if then == "resets":
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            with suppress(OSError):
                while then == "waits" and len(reply) < REPLY_BYTES and (received := connection.recv(1 << 16)):
                    reply += received
        return reply.decode(errors="replace")

    return attack


def crowd(number: int, attack: Attack) -> Attack:
    def together(wiring: Wiring[Any]) -> str:
        with ThreadPoolExecutor(number) as pool:
            return "\n".join(pool.map(attack, [wiring] * number))

    return together


def answers(*pieces: Block, then: Then = "waits", scheme: str = "", again: Sequence[bytes] = ()) -> Trap:
    """Return a server that answers any bytes with pieces, and then with those of ``again`` for ever."""

    @contextmanager
    def trap(_: Wiring[Any]) -> Iterator[str]:
        over = Event()

        def endless() -> Iterator[Block]:
            yield from pieces
            while again and not over.is_set():
                yield from again

        def serve() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    Thread(target=_answer, args=(connection, endless(), then, over), daemon=True).start()

        with socket.create_server(("127.0.0.1", 0)) as listener:
            Thread(target=serve, daemon=True).start()
            try:
                yield scheme + "{}:{}".format(*listener.getsockname())
            finally:
                over.set()
                listener.shutdown(socket.SHUT_RDWR)

    return trap


def _answer(connection: socket.socket, pieces: Iterator[Block], then: Then, over: Event) -> None:
    with connection, suppress(OSError):
        connection.settimeout(0.5)
        received = connection.recv(1 << 16)
        for piece in pieces:
            connection.sendall(piece(received) if callable(piece) else piece)
        if then == "resets":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            return
        if then == "goes":
            connection.shutdown(socket.SHUT_WR)  # closing with unread bytes would reset
        while not over.is_set():
            with suppress(TimeoutError):
                if not connection.recv(1 << 16):
                    return


CLIENTS: tuple[Case[Attack], ...] = (
    Case("silence", sends(seconds=1)),
    Case("gone at once", sends(then="goes")),
    Case("garbage", sends(NOISE)),
    Case("garbage and reset", sends(NOISE[:100], then="resets")),
    Case("1 GiB announced", sends(struct.pack("<I", GIB), NOISE)),
    Case("truncated message", sends(struct.pack("<I", 1000), b"{", then="goes")),
    Case("endless request", sends_made(lambda: ENDLESS[: 1 << 12])),
    Case("100 silent connections", crowd(100, sends(seconds=1))),
    Case("100 that come and go", crowd(100, sends(NOISE[:10], then="resets"))),
)
"""Hostile clients for any server over TCP."""


def servers(scheme: str = "") -> tuple[Case[Trap], ...]:
    return (
        Case("silence", answers(scheme=scheme), FAILED),
        Case("gone at once", answers(then="goes", scheme=scheme), FAILED),
        Case("garbage", answers(NOISE, scheme=scheme), FAILED),
        Case("1 GiB announced", answers(struct.pack("<I", GIB), NOISE, scheme=scheme), FAILED),
        Case("truncated message", answers(struct.pack("<I", 1000), b"{", then="goes", scheme=scheme), FAILED),
        Case("endless zeros", answers(again=[bytes(1 << 16)], scheme=scheme), FAILED),
    )
