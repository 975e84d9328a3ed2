"""Plain ROS 2 services on any middleware: one end of a service, and how a request of a stranger is answered."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

from s2a_bench.errors import TransportError
from s2a_bench.ros import REQUEST_BYTES

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
