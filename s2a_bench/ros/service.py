"""Plain ROS 2 services on any middleware: both ends of one, how a stranger's request is answered, how one waits."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any, Generic, Protocol, TypeVar

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import REQUEST_BYTES
from s2a_bench.ros.waiting import Waits, appeared

_log = logging.getLogger(__name__)
Caller = TypeVar("Caller")
"""What a middleware keeps of a request so that its reply finds who asked."""
Caller_contra = TypeVar("Caller_contra", contravariant=True)


class Service(Protocol[Caller_contra]):
    """The server's side of one service."""

    request_type: str
    reply_type: str

    def pack(self, body: Any, /) -> bytearray:
        """Serialise a reply."""
        ...

    def unpack(self, packed: memoryview, /) -> Any:
        """Deserialise a request; raises TransportError."""
        ...

    def respond(self, packed: bytearray, caller: Caller_contra, /) -> None:
        """Send a reply to who asked."""
        ...

    def reaches(self, caller: Caller_contra, /) -> bool:
        """Wait, a moment at most, until replies reach who asked; False if it has left."""
        ...


class Asker(Protocol):
    """The client's side of one service."""

    request_type: str
    hashed_type: str
    """The type whose hash a server announces."""

    def pack(self, body: Any, /) -> bytearray:
        """Serialise a request."""
        ...

    def call(self, packed: bytearray, goal_id: bytes, /) -> None:
        """Send a request that concerns ``goal_id``."""
        ...

    def replies(self) -> Iterator[tuple[bytes, memoryview]]:
        """Take what has arrived, a bounded number, as (goal id, CDR)."""
        ...

    def unpack(self, packed: memoryview, /) -> Any:
        """Deserialise a reply; raises TransportError."""
        ...

    def matched(self) -> bool:
        """Return whether a server is there."""
        ...

    def peer_type_hash(self) -> str:
        """Return the type hash that a server announces; empty without one."""
        ...


class Offered(Generic[Caller]):
    """One service of a node and what answers it."""

    def __init__(self, name: str, server: Service[Caller], answer: Callable[[Any], Any], body_at: int) -> None:
        """Answer the service ``/name``, whose requests' bodies begin at ``body_at`` of their CDR."""
        self.server = server
        self._name, self._answer, self._body_at = name, answer, body_at
        self._said = ""

    def handle(self, packed: memoryview, caller: Caller) -> None:
        """Answer one request, unless its client has left; what cannot be answered is dropped."""
        try:
            if not self._body_at < len(packed) <= REQUEST_BYTES:
                raise TransportError(f"{len(packed)} bytes are no request; the most is {REQUEST_BYTES}")
            response = self.server.pack(self._answer(self.server.unpack(packed)))
            if self.server.reaches(caller):
                self.server.respond(response, caller)
        except Exception as error:  # noqa: BLE001 - a stranger's request is no reason to stop
            said = type(error).__name__  # not its text, which a stranger can make a new one each time
            if said != self._said:
                self._said = said
                _log.warning("%s: dropped a request: %s", self._name, str(error)[:200])


class Calling:
    """Calls one service and waits for the answer."""

    def __init__(
        self, name: str, asker: Asker, ended: Callable[[], Iterator[tuple[bytes, memoryview | None]]], waiter: Waits
    ) -> None:
        """Call the service ``/name``; ``ended`` yields the replies, without CDR those of requests that were dropped."""
        self._name, self._asker, self._ended, self._waiter = name, asker, ended, waiter
        self._asked = 0

    def call(self, request: Any, timeout_s: float) -> Any:
        """Wait for the server, send, wait for the reply that is ours."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        if not appeared(self._asker.matched, timeout_s):
            raise TransportError(f"no server of the service {self._name} appeared in {timeout_s:g} s")
        self._asked += 1
        key = self._asked.to_bytes(8, "big")
        self._asker.call(self._asker.pack(request), key)
        silent = f"the service {self._name} did not answer in {timeout_s:g} s"
        while True:
            for answered, packed in self._ended():
                if answered == key:
                    if packed is None:
                        raise TransportError(f"{silent}: it has dropped the request")
                    return self._asker.unpack(packed)
            if not self._waiter.wait_until(deadline_ns):
                raise TransportError(silent)
