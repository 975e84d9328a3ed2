"""Hostile peers over any wire, our server in a process of its own that meets them, and what it uses."""

from __future__ import annotations

import random
import re
import socket
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread
from typing import Any, Literal, TypeAlias

from s2a_bench.clock import now_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.harness.processes import OwnServer
from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import STAND_IN, EngineConfig
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.types import Request
from tests.waiting import until

Attack: TypeAlias = "Callable[[Wiring[Any], str], str]"
"""A hostile client: meets the server of a wiring until it has heard a pattern, and returns what it heard."""
Trap: TypeAlias = "Callable[[], AbstractContextManager[str]]"
"""A hostile server: its address, HOST:PORT, for as long as the context lasts."""
Then: TypeAlias = Literal["listens", "leaves", "resets"]
"""A client's last act: it listens until it is answered or closed, leaves, or resets the connection."""
PATIENCE_S = 30.0
"""How long a peer waits to be answered or closed."""
PEAK_MIB = 512.0
"""The most memory that one hostile client costs a server, interpreter and libraries (some 110 MiB) included."""
TOKENS = 8
MIB = 1 << 20
NOISE = random.Random(1).randbytes(1 << 16)
CLOSED, LEFT = "<closed>", "<left>"
FORGED = "\x1b[2J\r\nOK: all is well\x07"


@dataclass(frozen=True, slots=True)
class Case:
    """One hostile client, and a pattern of our server's reply: by default any bytes, or an end of the connection."""

    name: str
    does: Attack
    says: str = "."


@dataclass(frozen=True, slots=True)
class Server:
    """One hostile server, and a pattern of our client's error."""

    name: str
    does: Trap
    says: str = "^(RequestFailed|MessagesLost|ServerDied|TransportError): ."
    timeout_s: float = PATIENCE_S
    deadline_s: float = 0.0
    """Of our client; 0: its default."""


def connect(wiring: Wiring[Any]) -> socket.socket:
    host, _, port = wiring.address.rpartition("//")[2].partition("/")[0].rpartition(":")
    return socket.create_connection((host, int(port)), timeout=PATIENCE_S)


def sends(*pieces: bytes | Callable[[], bytes], then: Then = "listens", greeted: int = 0) -> Attack:
    """Return a client that sends pieces over TCP; after the first it waits for ``greeted`` bytes."""

    def attack(wiring: Wiring[Any], says: str) -> str:
        heard = b""
        with connect(wiring) as connection:
            with suppress(OSError):  # the server refuses the rest
                for piece in pieces:
                    connection.sendall(piece() if callable(piece) else piece)
                    while len(heard) < greeted and (data := connection.recv(1 << 16)):
                        heard += data
            if then == "resets":
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            return _heard(connection, heard, says) if then == "listens" else LEFT

    return attack


def _heard(connection: socket.socket, heard: bytes, says: str) -> str:
    """Listen until a pattern is heard or the server closes; a peer whose patience ends was not answered."""
    while not (re.search(says, text := heard.decode(errors="replace"), re.DOTALL) and heard):
        try:
            data = connection.recv(1 << 16)
        except TimeoutError:
            return text
        except OSError:
            data = b""
        if not data:
            return text + CLOSED
        heard += data
    return text


def crowd(number: int, attack: Attack) -> Attack:
    """Return so many clients at once; the first that was not answered speaks for all."""

    def together(wiring: Wiring[Any], says: str) -> str:
        with ThreadPoolExecutor(number) as pool:
            replies = [*pool.map(attack, [wiring] * number, [says] * number)]
        return next((reply for reply in replies if not re.search(says, reply, re.DOTALL)), replies[0])

    return together


def hears(word: bytes) -> Callable[[socket.socket, bytes], bytes]:
    """Return a step of `answers`: wait until the client has sent a word."""

    def step(connection: socket.socket, heard: bytes) -> bytes:
        while word not in heard and (data := connection.recv(1 << 16)):
            heard += data
        return b""

    return step


Step: TypeAlias = "bytes | Callable[[socket.socket, bytes], bytes]"


def answers(*steps: Step, again: bytes = b"", every_s: float = 0.0, leaves: bool = False) -> Trap:
    """Return a server that answers any first bytes in steps, then with ``again`` for ever, and listens or leaves."""

    @contextmanager
    def trap() -> Iterator[str]:
        over = Event()

        def answer(connection: socket.socket) -> None:
            with connection, suppress(OSError):
                connection.settimeout(PATIENCE_S)
                heard = connection.recv(1 << 16)
                for step in steps:
                    connection.sendall(step(connection, heard) if callable(step) else step)
                while again and not over.wait(every_s):
                    connection.sendall(again)
                if leaves:
                    connection.shutdown(socket.SHUT_WR)  # to close with bytes unread would reset the connection
                while connection.recv(1 << 16):
                    pass

        def serve() -> None:
            with suppress(OSError):
                while True:
                    Thread(target=answer, args=(listener.accept()[0],), daemon=True).start()

        with socket.create_server(("127.0.0.1", 0)) as listener:
            Thread(target=serve, daemon=True).start()
            try:
                yield "{}:{}".format(*listener.getsockname())
            finally:
                over.set()
                listener.shutdown(socket.SHUT_RDWR)

    return trap


PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class Usage:
    rss_mib: float
    peak_mib: float
    """The most resident memory (VmHWM) since the start, or since `forget_peak`."""
    threads: int
    descriptors: int


def family(pid: int) -> Iterator[int]:
    with suppress(OSError):
        tasks = [*(PROC / str(pid) / "task").iterdir()]
        yield pid
        for task in tasks:
            with suppress(OSError):
                for child in (task / "children").read_text().split():
                    yield from family(int(child))


def usage(pid: int) -> Usage:
    rss, peak, threads, descriptors = 0, 0, 0, 0
    for member in family(pid):
        with suppress(OSError):  # it has just ended
            lines = (PROC / str(member) / "status").read_text().splitlines()
            status = {name: value.split() for name, _, value in (line.partition(":\t") for line in lines)}
            rss += int(status.get("VmRSS", "0")[0])
            peak += int(status.get("VmHWM", "0")[0])
            threads += int(status["Threads"][0])
            descriptors += len([*(PROC / str(member) / "fd").iterdir()])
    return Usage(rss / 1024, peak / 1024, threads, descriptors)


def forget_peak(pid: int) -> None:
    """Reset the peak (proc(5), clear_refs), if that is allowed."""
    for member in family(pid):
        with suppress(OSError):
            (PROC / str(member) / "clear_refs").write_text("5")


@contextmanager
def own_server(wiring: Wiring[Any], log: Path) -> Iterator[OwnServer]:
    """Run a server in a separate process, with the echo engine."""
    config = EngineConfig(name=STAND_IN, answer=wiring.capabilities.answer_kinds[0])
    server = OwnServer("hostile", ServerJob(wiring, config), log)
    with server:
        server.wait_ready()
        yield server


def normal_answer(client: Client) -> list[str]:
    """Return the answer to one short request; while the server is busy it is repeated."""
    deadline = now_ns() + round(PATIENCE_S * 1e9)
    while True:
        try:
            return [piece.text for piece in ask(client, Request("normal", "go on", max_tokens=3))[0]]
        except RequestFailed as error:
            if error.retry_after_s is None or now_ns() > deadline:
                raise
            Event().wait(error.retry_after_s)


class Target:
    """Our server, with a normal client that stays connected."""

    def __init__(self, wiring: Wiring[Any], server: OwnServer, normal: Client) -> None:
        self.wiring, self.server, self._normal = wiring, server, normal
        self._expected = normal_answer(normal)
        assert self._expected

    def meets(self, case: Case) -> None:
        """Let a hostile client come: it is answered or closed, then the normal one is, and little memory was used."""
        pid, before = self.server.pid, usage(self.server.pid)
        forget_peak(pid)
        reply = case.does(self.wiring, case.says)
        assert normal_answer(self._normal) == self._expected
        assert self.server.alive()
        assert re.search(case.says, reply, re.DOTALL), f"neither answered so nor closed: {reply[:1000]}"
        assert usage(pid).peak_mib < PEAK_MIB
        until(lambda: usage(pid).descriptors <= before.descriptors)


@contextmanager
def target(name: str, log: Path) -> Iterator[Target]:
    wiring = wiring_of(name, timeout_s=PATIENCE_S, max_tokens=TOKENS)
    with ExitStack() as stack:
        server = stack.enter_context(own_server(wiring, log))
        bound = replace(wiring, address=server.address)
        yield Target(bound, server, stack.enter_context(closing(open_client(bound))))
