"""Plain ROS 2 services on Cyclone DDS: all that one node offers, on one thread, and a client that waits."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros.dds import Waiter
from s2a_bench.ros.dds_service import BODY_AT, Caller, ServiceClient, ServiceServer
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.service import Offered
from s2a_bench.ros.waiting import WAIT_SLICE_NS, appeared


class CycloneServices:
    """The services of one node."""

    def __init__(self, participant: DomainParticipant) -> None:
        """Start the thread that answers."""
        self._participant = participant
        self._waiter = Waiter(participant, [])
        self._offered: list[tuple[ServiceServer, Offered[Caller]]] = []
        self._lock = Lock()
        self._thread = Thread(target=self._serve, name="services", daemon=True)
        self._thread.start()

    def offer(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS) -> ServiceServer:
        """Create the service ``/name`` and answer it from now on."""
        server = ServiceServer(self._participant, name, type_name, DEFAULT_VERSION, qos)
        with self._lock:
            self._offered = [*self._offered, (server, Offered(name, server, answer, BODY_AT))]
            self._waiter.watch(server.reader)
        return server

    def close(self) -> None:
        """End the thread; endpoints go with the participant."""
        self._waiter.interrupt()
        self._thread.join()

    def _serve(self) -> None:
        while not self._waiter.interrupted:
            for server, offered in self._offered:
                for packed in server.reader.arrived():
                    offered.handle(packed, server.caller(packed))
            self._waiter.wait_until(now_ns() + WAIT_SLICE_NS)


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
