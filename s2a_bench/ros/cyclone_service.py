"""Plain ROS 2 services on Cyclone DDS: all that one node offers, on one thread, and a client that waits."""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import REQUEST_BYTES, QoS
from s2a_bench.ros.dds import Waiter
from s2a_bench.ros.dds_service import BODY_AT, HEADER, HEADER_AT, ServiceClient, ServiceServer
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.waiting import WAIT_SLICE_NS, appeared

_log = logging.getLogger(__name__)


class CycloneServices:
    """The services of one node."""

    def __init__(self, participant: DomainParticipant) -> None:
        """Start the thread that answers."""
        self._participant = participant
        self._waiter = Waiter(participant, [])
        self._offered: list[_Offered] = []
        self._lock = Lock()
        self._thread = Thread(target=self._serve, name="services", daemon=True)
        self._thread.start()

    def offer(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS) -> ServiceServer:
        """Create the service ``/name`` and answer it from now on."""
        server = ServiceServer(self._participant, name, type_name, DEFAULT_VERSION, qos)
        with self._lock:
            self._offered = [*self._offered, _Offered(name, server, answer)]
            self._waiter.watch(server.reader)
        return server

    def close(self) -> None:
        """End the thread; endpoints go with the participant."""
        self._waiter.interrupt()
        self._thread.join()

    def _serve(self) -> None:
        while not self._waiter.interrupted:
            for offered in self._offered:
                for packed in offered.server.reader.arrived():
                    offered.handle(packed)
            self._waiter.wait_until(now_ns() + WAIT_SLICE_NS)


class _Offered:
    """One service and what answers it."""

    def __init__(self, name: str, server: ServiceServer, answer: Callable[[Any], Any]) -> None:
        self.server = server
        self._name, self._answer = name, answer
        self._said = ""

    def handle(self, packed: memoryview) -> None:
        """Answer one request, unless its client has left; what cannot be answered is dropped."""
        sender = self.server.reader.sender()
        try:
            if not BODY_AT < len(packed) <= REQUEST_BYTES:
                raise TransportError(f"{len(packed)} bytes are no request; the most is {REQUEST_BYTES}")
            response = self.server.pack(self._answer(self.server.unpack(packed)))
            if self.server.await_client(sender):
                self.server.reply(response, HEADER.unpack_from(packed, HEADER_AT))
        except Exception as error:  # noqa: BLE001 - a stranger's request is no reason to stop
            said = type(error).__name__  # not its text, which a stranger can make a new one each time
            if said != self._said:
                self._said = said
                _log.warning("%s: dropped a request: %s", self._name, str(error)[:200])


class CycloneServiceClient:
    """Calls one service and waits for the answer."""

    def __init__(self, participant: DomainParticipant, name: str, type_name: str) -> None:
        """Create the client's endpoints of the service ``/name``."""
        self._name = name
        self._client = ServiceClient(participant, name, type_name, DEFAULT_VERSION)
        self._waiter = Waiter(participant, [self._client.reader])
        self._asked = 0
        self.ends = self._client.ends

    def call(self, request: Any, timeout_s: float) -> Any:
        """Wait for the server, send, wait for the reply that is ours."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        if not appeared(self._client.matched, timeout_s):
            raise TransportError(f"no server of the service {self._name} appeared in {timeout_s:g} s")
        self._asked += 1
        key = self._asked.to_bytes(8, "big")
        self._client.call(self._client.pack(request), key)
        while True:
            for answered, packed in self._client.replies():
                if answered == key:
                    return self._client.unpack(packed)
            if not self._waiter.wait_until(deadline_ns):
                raise TransportError(f"the service {self._name} did not answer in {timeout_s:g} s")
