"""The two ends of the fault matrix, each a process of its own, and what can be cut between them."""

from __future__ import annotations

import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from threading import Thread
from typing import Any

from s2a_bench.errors import MessagesLost, S2AError
from s2a_bench.harness.processes import OwnServer
from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import EngineConfig
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.trace import RESIDUAL, Trace
from s2a_bench.transport import Wiring, open_client
from s2a_bench.types import Request

TOKENS, PER_S = 24, 25.0
SILENCE_S, BOUND_S = 4.0, 20.0
"""The client's ``timeout_s``, and when all must be over."""
FORKS = get_context("forkserver")
FORKS.set_forkserver_preload(["benchmarks.faults.peers"])
_numbers = count()


class Peer:
    """The client's process."""

    def __init__(self, wiring: Wiring[Any], server_pid: int) -> None:
        """Start it: a fork of a process that has imported all this already."""
        self._pipe, other = FORKS.Pipe()
        self.process = FORKS.Process(target=client, args=(other, wiring.to_json(), server_pid), daemon=True)
        self.process.start()
        other.close()

    @property
    def pid(self) -> int:
        """Return its process id."""
        assert self.process.pid  # noqa: S101 - it has started
        return self.process.pid

    def tell(self, what: str) -> None:
        """Tell it to "ask" or to "close"."""
        with suppress(OSError):
            self._pipe.send(what)

    def hear(self, event: str, seconds: float = BOUND_S) -> dict[str, Any]:
        """Return the next of these events; raises TimeoutError, or EOFError where the client ended."""
        deadline = time.monotonic() + seconds
        while self._pipe.poll(max(0.0, deadline - time.monotonic())):
            message: dict[str, Any] = self._pipe.recv()
            if message["event"] == event:
                return message
        raise TimeoutError(f"the client came to no {event} within {seconds:g} s")

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.join()


def client(pipe: Any, wiring: dict[str, Any], server_pid: int) -> None:
    """Ask, and say how it goes, until told to close."""
    own = open_client(Wiring.from_json(wiring), lambda: _lives(server_pid))
    pipe.send({"event": "ready"})
    while pipe.recv() != "close":
        trace, got, error = Trace(), 0, ""
        trace.mark(RESIDUAL)
        pipe.send({"event": "asking"})
        try:
            for _ in own.request(Request("victim", "go on", max_tokens=TOKENS), trace):
                got += 1
                pipe.send({"event": "token"})
        except S2AError as failure:
            error = f"{type(failure).__name__}: {failure}"
        except Exception as failure:  # noqa: BLE001 - the finding
            error = f"Traceback\n{failure!r}"
        pipe.send({"event": "end", "tokens": got, "error": error})
    own.close()
    pipe.send({"event": "closed"})


def _lives(pid: int) -> bool:
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


@contextmanager
def relayed(address: str) -> Iterator[tuple[str, Callable[[], None]]]:
    """Pass bytes on between an address of its own and a server's; the second value cuts all, for good."""
    scheme, _, place = address.rpartition("//")
    host, _, port = place.rpartition(":")
    sockets: list[socket.socket] = []
    listener = socket.create_server(("127.0.0.1", 0))

    def pump(source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)

    def serve() -> None:
        with suppress(OSError):
            while True:
                here, _ = listener.accept()
                there = socket.create_connection((host, int(port)))
                sockets.extend((here, there))
                for pair in ((here, there), (there, here)):
                    Thread(target=pump, args=pair, daemon=True).start()

    def cut() -> None:
        with suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        for each in sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    Thread(target=serve, daemon=True).start()
    try:
        yield "{}//{}:{}".format(scheme, *listener.getsockname()), cut
    finally:
        cut()


@contextmanager
def serving(transport: str) -> Iterator[OwnServer]:
    """Run a server whose answers take a second."""
    wiring = wiring_of(transport, timeout_s=SILENCE_S, max_tokens=TOKENS)
    if transport.startswith("ros"):
        wiring = replace(wiring, address=f"/faults_{next(_numbers)}")
    answer = wiring.capabilities.answer_kinds[0]
    engine = EngineConfig(name="echo", pace=PER_S, answer=answer, horizon=TOKENS)
    with tempfile.TemporaryDirectory() as folder:
        server = OwnServer("faulty", ServerJob(wiring, engine), Path(folder) / "log")
        with server:
            server.wait_ready()
            yield server


def others(server: OwnServer, transport: str) -> str:
    """Return an error of somebody else's request, or nothing; whose messages were lost comes again."""
    wiring = wiring_of(transport, server.address, timeout_s=BOUND_S, max_tokens=TOKENS)
    error = ""
    for _ in range(3):
        try:
            with closing(open_client(wiring, server.alive)) as client:
                tokens, _ = ask(client, Request("other", "go on", max_tokens=TOKENS))
            return "" if len(tokens) == TOKENS else f"{len(tokens)} tokens"
        except MessagesLost as lost:
            error = str(lost)
        except S2AError as failure:
            return f"{type(failure).__name__}: {failure}"
    return error
