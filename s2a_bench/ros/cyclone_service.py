"""Plain ROS 2 services on Cyclone DDS: all that one node offers, on one thread, and a client that waits."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros.dds import Waiter
from s2a_bench.ros.dds_service import BODY_AT, Caller, ServiceClient, ServiceServer
from s2a_bench.ros.messages import DEFAULT_VERSION
from s2a_bench.ros.service import Calling, Offered
from s2a_bench.ros.waiting import WAIT_SLICE_NS


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


class CycloneServiceClient(Calling):
    """Calls one service over two endpoints of its own."""

    def __init__(self, participant: DomainParticipant, name: str, type_name: str) -> None:
        """Create the client's endpoints of the service ``/name``."""
        client = ServiceClient(participant, name, type_name, DEFAULT_VERSION)
        super().__init__(name, client, client.replies, Waiter(participant, [client.reader]))
        self.ends = client.ends
