"""What is killed, when, over which transport, and what comes of it: ``python -m benchmarks.faults``.

A server and its client are processes of their own; the fault falls at a moment of a request of 24 tokens, 40 ms each.
Then the client must have ended with one line and within its bound, and the server must answer another client.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, nullcontext, suppress
from dataclasses import dataclass
from threading import Event, Thread

from benchmarks.faults.peers import BOUND_S, SILENCE_S, TOKENS, Peer, others, relayed, serving
from s2a_bench.errors import S2AError
from s2a_bench.harness.processes import OwnServer
from s2a_bench.testing.transport import wiring_of
from s2a_bench.trace import Trace
from s2a_bench.transport import open_client
from s2a_bench.types import Request

TRANSPORTS = (
    *("http/as-deployed", "http/best-effort", "http/binary", "ros/topic", "ros/action", "iceoryx2"),
    *("websocket/openpi-stream", "zmq/gr00t"),
)
WHOLE = ("zmq/gr00t",)
"""Those whose answers come as one."""
BEGUN_S = 0.3
"""Time after a request at which its answer has begun, if no event shows it."""
WHATS = ("server killed", "server told to end", "server stopped", "client killed", "client stopped", "connection cut")
WHENS = ("before the first request", "in the queue", "in the middle of an answer", "between requests", "while closing")
ENDS_THE_SERVER = ("server killed", "server told to end")


@dataclass(frozen=True, slots=True)
class Fault:
    """One cell of the matrix."""

    what: str
    when: str
    transport: str

    def __str__(self) -> str:
        """Name it, as an id of a test."""
        return f"{self.transport}, {self.what}, {self.when}"

    @property
    def applies(self) -> bool:
        """Return True if the fault can occur: DDS has no connection, and a client in the queue has sent a request."""
        return self.what != "connection cut" or self.transport.startswith(("http", "websocket", "zmq"))

    @property
    def promised(self) -> tuple[str, ...]:
        """Return what may come of it."""
        if self.what == "client killed":
            return ("the next is answered",)
        if self.what == "client stopped":
            return ("answered when it goes on", "one line when it goes on")
        if self.when == "while closing":
            return ("closes",)
        if self.what == "connection cut" and self.when in {"before the first request", "between requests"}:
            return ("one line", "answered")  # a new connection, where the other end still listens
        if self.what == "server told to end":
            return ("one line", "answered")  # what is under way may have its second
        return ("one line",)


FAULTS = [
    fault
    for transport in TRANSPORTS
    for what in WHATS
    for when in WHENS
    if (fault := Fault(what, when, transport)).applies
]


def outcomes(faults: Collection[Fault], lanes: int = 1) -> dict[Fault, str]:
    """Let all faults happen, those of a transport one after the other in so many lanes; return what came of each."""
    of_each = [[fault for fault in faults if fault.transport == each] for each in {fault.transport for fault in faults}]
    parts = [part for of_one in of_each for lane in range(lanes) if (part := of_one[lane::lanes])]
    with ThreadPoolExecutor(max(1, len(parts))) as pool:
        return {fault: outcome for came in pool.map(_over, parts) for fault, outcome in came.items()}


def _over(faults: Sequence[Fault]) -> dict[Fault, str]:
    """Return what came of the faults of one lane; one server has to outlive all that do not end it."""
    came: dict[Fault, str] = {}
    with serving(faults[0].transport) as lasting:
        for fault in faults:
            with serving(fault.transport) if fault.what in ENDS_THE_SERVER else nullcontext(lasting) as server:
                try:
                    came[fault] = happens(fault, server)
                except Exception as error:  # noqa: BLE001 - a finding like another
                    came[fault] = f"{type(error).__name__}: {error}"
    return came


def happens(fault: Fault, server: OwnServer) -> str:
    """Let the fault happen and return what came of it; raises where something hangs."""
    with ExitStack() as stack:
        address, cut = server.address, lambda: None
        if fault.what == "connection cut":
            address, cut = stack.enter_context(relayed(server.address))
        wiring = wiring_of(fault.transport, address, timeout_s=SILENCE_S, max_tokens=TOKENS)
        peer = Peer(wiring, server.pid)
        stack.callback(peer.close)
        peer.hear("ready", seconds=60)
        if fault.when == "in the queue":
            over = Event()
            stack.callback(_occupied(server, fault.transport, over).join)
            stack.callback(over.set)
        _reach(fault, peer)
        stack.callback(_strike(fault.what, server, peer, cut))
        return _outcome(fault, server, peer)


def _occupied(server: OwnServer, transport: str, over: Event) -> Thread:
    """Occupy the engine with another client for a while."""
    started = Event()

    def hold() -> None:
        wiring = wiring_of(transport, server.address, timeout_s=SILENCE_S, max_tokens=TOKENS)
        with suppress(S2AError), closing(open_client(wiring, server.alive)) as client:
            for _ in client.request(Request("first", "go on", max_tokens=TOKENS), Trace()):
                started.set()
                if over.is_set():
                    return

    thread = Thread(target=hold, daemon=True)
    thread.start()
    started.wait(BEGUN_S if transport in WHOLE else BOUND_S)
    return thread


def _reach(fault: Fault, peer: Peer) -> None:
    """Bring the client to the moment of the fault."""
    when = fault.when
    if when in {"between requests", "while closing"}:
        peer.tell("ask")
        peer.hear("end")
    elif when != "before the first request":
        peer.tell("ask")
        peer.hear("asking")
        if when == "in the middle of an answer" and fault.transport in WHOLE:
            time.sleep(BEGUN_S)
        elif when == "in the middle of an answer":
            peer.hear("token")
        else:
            time.sleep(0.2)  # it is on its way into the queue, where the first one's second has just begun


def _strike(what: str, server: OwnServer, peer: Peer, cut: Callable[[], None]) -> Callable[[], None]:
    """Do it; return what undoes it."""
    victim = server.pid if what.startswith("server") else peer.pid
    if what == "connection cut":
        cut()
        return lambda: None
    number = {"killed": signal.SIGKILL, "told to end": signal.SIGTERM, "stopped": signal.SIGSTOP}[
        what.partition(" ")[2]
    ]
    _signal(victim, number)
    if number == signal.SIGKILL:
        time.sleep(0.1)
    return lambda: _signal(victim, signal.SIGCONT)


def _signal(pid: int, number: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def _outcome(fault: Fault, server: OwnServer, peer: Peer) -> str:
    """Return what the client says, and check that the server answers others."""
    client_lives = fault.what != "client killed"
    if fault.what == "client stopped":
        if error := others(server, fault.transport):
            return f"others are not answered meanwhile: {error}"
        _signal(peer.pid, signal.SIGCONT)
    outcome = _message(fault, peer) if client_lives else "the next is answered"
    if fault.what == "server stopped":
        _signal(server.pid, signal.SIGCONT)
    if fault.what in ENDS_THE_SERVER:
        return outcome if server.ends_within(10) else "the server did not end"
    error = others(server, fault.transport)
    return f"others are not answered afterwards: {error}" if error else outcome


def _message(fault: Fault, peer: Peer) -> str:
    """Return how the client ended."""
    later = " when it goes on" if fault.what == "client stopped" else ""
    if fault.when == "while closing":
        peer.tell("close")
        peer.hear("closed")
        return "answered" + later if later else "closes"
    if fault.when in {"before the first request", "between requests"}:
        peer.tell("ask")
    end = peer.hear("end")
    if not end["error"]:
        return "answered" + later
    return ("one line" if end["error"].isprintable() else f"several lines: {end['error']}") + later
