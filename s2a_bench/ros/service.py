"""Plain ROS 2 services on any middleware: both ends of one, how a node answers requests from outside, how all wait."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any, Final, Generic, Protocol, TypeVar

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import REQUEST_BYTES, QoS

WAIT_SLICE_NS: Final = 500_000_000
"""A blocked wait returns to Python this often, so that Ctrl-C acts."""
AT_ONCE: Final = 1000
"""More than that is not taken before what has come is looked at."""
READER_QOS: Final = QoS(depth=0)
"""Our readers keep all, whatever ROS does: history is local, and a burst overruns ROS's default of 10."""
MATCH_POLL_S: Final = 0.01
"""rclpy's own waiting looks four times a second."""

_log = logging.getLogger(__name__)
Caller = TypeVar("Caller")
"""What a middleware keeps of a request to address its reply."""


class Waits(Protocol):
    """Waits for anything to arrive."""

    interrupted: bool

    def wait_until(self, deadline_ns: int, /) -> bool:
        """Return after data, a time slice or an interrupt; False once the deadline or an interrupt has come."""
        ...

    def interrupt(self) -> None:
        """End a wait under way and every later one; callable from any thread."""
        ...


def appeared(present: Callable[[], bool], timeout_s: float, given_up: Callable[[], bool] = lambda: False) -> bool:
    """Poll ``present`` every 10 ms; False after ``timeout_s``, or once ``given_up`` is True."""
    deadline_ns = now_ns() + int(timeout_s * 1e9)
    while not present():
        if now_ns() > deadline_ns or given_up():
            return False
        time.sleep(MATCH_POLL_S)
    return True


class End(Protocol):
    """What both sides of one service have in common."""

    request_type: str
    body_at: int
    """Where bodies begin in the CDR."""

    def pack(self, body: Any, /) -> bytearray: ...

    def unpack(self, packed: memoryview, /) -> Any:
        """Deserialise what the other side sent; raises TransportError."""
        ...


class ServiceEnd(End, Protocol[Caller]):
    """The server's side of one service."""

    reply_type: str

    def arrived(self) -> Iterator[tuple[memoryview, Caller]]:
        """Take the requests that have arrived, a bounded number: CDR and caller."""
        ...

    def respond(self, packed: bytearray, caller: Caller, /) -> None: ...

    def reaches(self, caller: Caller, /) -> bool:
        """Wait, 100 ms at most, until replies reach the caller; False if it has left."""
        ...

    def drop(self, caller: Caller, /) -> None:
        """Let go of a request, which may have been answered."""
        ...


class ClientEnd(End, Protocol):
    """The client's side of one service."""

    hashed_type: str
    """The type whose hash a server announces."""

    def call(self, packed: bytearray, key: bytes, /) -> None:
        """Send a request, to which ``key`` belongs: a goal's id, where it concerns one."""
        ...

    def replies(self) -> Iterator[tuple[bytes, memoryview | None]]:
        """Take the replies that have arrived, a bounded number: key, and CDR, None where the request was dropped."""
        ...

    def matched(self) -> bool: ...

    def peer_type_hash(self) -> str:
        """Return the type hash that a server announces; empty without one."""
        ...


class Services(Generic[Caller]):
    """The services of one node, answered by one thread."""

    def __init__(self, waiter: Waits) -> None:
        """Start the thread; ``waiter`` wakes it for requests."""
        self._waiter = waiter
        self._offered: dict[str, tuple[ServiceEnd[Caller], Callable[[Any], Any]]] = {}
        self._logged: dict[str, str] = {}
        """Service -> what was logged of it last."""
        self._thread = Thread(target=self._serve, name="services", daemon=True)
        self._thread.start()

    def offer(self, name: str, service: ServiceEnd[Caller], answer: Callable[[Any], Any]) -> None:
        """Answer the service ``/name`` from now on."""
        self._offered = {**self._offered, name: (service, answer)}  # while the thread goes through the old ones

    def close(self) -> None:
        self._waiter.interrupt()
        self._thread.join()

    def _serve(self) -> None:
        while not self._waiter.interrupted:
            for name, (service, answer) in self._offered.items():
                for packed, caller in service.arrived():
                    self._handle(name, service, answer, packed, caller)
                    service.drop(caller)
            self._waiter.wait_until(now_ns() + WAIT_SLICE_NS)

    def _handle(
        self, name: str, service: ServiceEnd[Caller], answer: Callable[[Any], Any], packed: memoryview, caller: Caller
    ) -> None:
        """Answer one request, unless its client has left; what cannot be answered is dropped."""
        try:
            if not service.body_at < len(packed) <= REQUEST_BYTES:
                raise TransportError(f"{len(packed)} bytes are no request; the most is {REQUEST_BYTES}")
            response = service.pack(answer(service.unpack(packed)))
            if service.reaches(caller):
                service.respond(response, caller)
        except Exception as error:  # noqa: BLE001 - a bad request is no reason to stop
            kind = type(error).__name__  # not its text, which a client can vary each time
            if kind != self._logged.get(name):
                self._logged[name] = kind
                _log.warning("%s: dropped a request: %s", name, str(error)[:200])


class Calling:
    """Calls one service and waits for the answer."""

    def __init__(self, name: str, client: ClientEnd, waiter: Waits) -> None:
        self._name, self._client, self._waiter = name, client, waiter
        self._calls = 0

    def call(self, request: Any, timeout_s: float) -> Any:
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        if not appeared(self._client.matched, timeout_s):
            raise TransportError(f"no server of the service {self._name} appeared in {timeout_s:g} s")
        self._calls += 1
        key = self._calls.to_bytes(8, "big")
        self._client.call(self._client.pack(request), key)
        silent = f"the service {self._name} did not answer in {timeout_s:g} s"
        while True:
            for answered, packed in self._client.replies():
                if answered == key:
                    if packed is None:
                        raise TransportError(f"{silent}: it has dropped the request")
                    return self._client.unpack(packed)
            if not self._waiter.wait_until(deadline_ns):
                raise TransportError(silent)
