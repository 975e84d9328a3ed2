"""Hostile peers of any transport over TCP, which know nothing of its messages, and what makes others of bytes alone."""

from __future__ import annotations

import random
import socket
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Event, Thread
from typing import Any, Literal, TypeAlias

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.testing.hostile import FAILED, Attack, Case, Trap
from s2a_bench.transport import Wiring

Then: TypeAlias = Literal["waits", "goes", "resets"]
"""What a peer does after its last byte: it listens until the other side closes, or closes itself, orderly or not."""
Pieces: TypeAlias = "Sequence[bytes] | Callable[[], Sequence[bytes]]"
Said: TypeAlias = "bytes | Callable[[bytes], bytes]"
"""Bytes, or what makes them of those that came first."""
GIB = 1 << 30
NOISE = random.Random(1).randbytes(1 << 16)
ENDLESS = [bytes(1 << 16)] * (1 << 16)
"""4 GiB."""
RESET = struct.pack("ii", 1, 0)
SAID_BYTES = 1 << 20


def connect(wiring: Wiring[Any], seconds: float) -> socket.socket:
    """Connect to ``host:port``, or to a URL with them."""
    host, _, port = wiring.address.rpartition("//")[2].partition("/")[0].rpartition(":")
    return socket.create_connection((host, int(port)), timeout=seconds)


def sends(*pieces: bytes, **more: Any) -> Attack:
    """Return a client like that of `sends_made`, whose pieces are known."""
    return sends_made(lambda: pieces, **more)


def sends_made(
    make: Callable[[], Iterable[bytes]],
    *,
    then: Then = "waits",
    seconds: float = 2.0,
    every_s: float = 0.0,
    first: int = 0,
) -> Attack:
    """Return a client that sends pieces, one each ``every_s``; it listens for ``seconds`` at most.

    After its first piece it goes on when ``first`` bytes have come.
    """

    def attack(wiring: Wiring[Any]) -> str:
        said, clock = b"", SystemClock()
        with connect(wiring, seconds) as connection:
            try:
                for piece in make():
                    connection.sendall(piece)
                    while len(said) < first and (heard := connection.recv(1 << 16)):
                        said += heard
                    if every_s:
                        clock.sleep_until_ns(now_ns() + round(every_s * 1e9))
            except OSError:
                pass  # it has heard enough
            if then == "resets":
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            with suppress(OSError):
                while then == "waits" and len(said) < SAID_BYTES and (piece := connection.recv(1 << 16)):
                    said += piece
        return said.decode(errors="replace")

    return attack


def crowd(number: int, attack: Attack) -> Attack:
    """Return many clients at once."""

    def together(wiring: Wiring[Any]) -> str:
        said: list[str] = []
        threads = [Thread(target=lambda: said.append(attack(wiring))) for _ in range(number)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return "\n".join(said)

    return together


def answers(*pieces: Said, then: Then = "waits", scheme: str = "", again: Sequence[bytes] = ()) -> Trap:
    """Return a server that answers whatever comes with pieces, and then with those of ``again`` for ever."""

    @contextmanager
    def trap(_: Wiring[Any]) -> Iterator[str]:
        over = Event()

        def endless() -> Iterator[Said]:
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


def _answer(connection: socket.socket, pieces: Iterator[Said], then: Then, over: Event) -> None:
    with connection, suppress(OSError):
        connection.settimeout(0.5)
        heard = connection.recv(1 << 16)
        for piece in pieces:
            connection.sendall(piece(heard) if callable(piece) else piece)
        if then == "resets":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            return
        if then == "goes":
            connection.shutdown(socket.SHUT_WR)  # closing what has come unread would reset
        while not over.is_set():
            with suppress(TimeoutError):
                if not connection.recv(1 << 16):
                    return


LITTLE, BIG = struct.pack("<I", GIB), struct.pack(">I", GIB)

CLIENTS: tuple[Case[Attack], ...] = (
    Case("silence", sends(seconds=1)),
    Case("gone at once", sends(then="goes")),
    Case("garbage", sends(NOISE)),
    Case("garbage and gone", sends(NOISE, then="goes")),
    Case("garbage and reset", sends(NOISE[:100], then="resets")),
    Case("zeros", sends(bytes(1 << 20))),
    Case("1 GiB announced", sends(LITTLE, NOISE)),
    Case("1 GiB announced, big-endian", sends(BIG, NOISE)),
    Case("truncated message", sends(struct.pack("<I", 1000), b"{", then="goes")),
    Case("endless request", sends_made(lambda: ENDLESS[: 1 << 12])),
    Case("100 silent connections", crowd(100, sends(seconds=1))),
    Case("100 that come and go", crowd(100, sends(NOISE[:10], then="resets"))),
)
"""What any server over TCP outlives."""


def servers(scheme: str = "") -> tuple[Case[Trap], ...]:
    """Return what any client over TCP outlives."""
    return (
        Case("silence", answers(scheme=scheme), FAILED),
        Case("gone at once", answers(then="goes", scheme=scheme), FAILED),
        Case("garbage", answers(NOISE, scheme=scheme), FAILED),
        Case("garbage and reset", answers(NOISE[:100], then="resets", scheme=scheme), FAILED),
        Case("zeros", answers(bytes(1 << 20), scheme=scheme), FAILED),
        Case("1 GiB announced", answers(LITTLE, NOISE, scheme=scheme), FAILED),
        Case("1 GiB announced, big-endian", answers(BIG, NOISE, scheme=scheme), FAILED),
        Case("truncated message", answers(struct.pack("<I", 1000), b"{", then="goes", scheme=scheme), FAILED),
        Case("endless zeros", answers(again=[bytes(1 << 16)], scheme=scheme), FAILED),
        Case("endless noise", answers(again=[NOISE], scheme=scheme), FAILED),
    )


SERVERS = servers()
