"""The middleware on Cyclone DDS from PyPI: ready CDR in, views of the received CDR out, ROS 2 names outside."""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable
from importlib.metadata import version as package_version
from threading import Lock
from typing import Any

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.qos import Policy, Qos

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import SERVICE_QOS, QoS, Tuning
from s2a_bench.ros.config import configuration
from s2a_bench.ros.cyclone_client import CycloneActionClient
from s2a_bench.ros.cyclone_server import CycloneActionServer
from s2a_bench.ros.cyclone_service import CycloneServiceClient, CycloneServices
from s2a_bench.ros.dds import RawReader, RawWriter, Waiter, dds_qos
from s2a_bench.ros.graph import NodeAnnouncement
from s2a_bench.ros.messages import DEFAULT_VERSION, deserialise, serialise, type_hash


def _topic_qos(qos: QoS, type_name: str) -> Qos:
    return dds_qos(qos, f"typehash={type_hash(type_name)};")


class _CyclonePublisher(RawWriter):
    """Sends messages to a ROS topic."""

    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS) -> None:
        super().__init__(participant, "rt" + topic, type_name, _topic_qos(qos, type_name))
        self._type_name = type_name

    def pack(self, message: Any) -> bytearray:
        """Serialise to CDR."""
        return serialise(message, self._type_name)


class _CycloneSubscription:
    """Receives messages from a ROS topic, on the consuming thread."""

    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS) -> None:
        self._type_name = type_name
        self.reader = RawReader(participant, "rt" + topic, type_name, _topic_qos(qos, type_name))
        self._waiter = Waiter(participant, [self.reader])
        self.interrupt = self._waiter.interrupt
        self.matched = self.reader.matched

    def take(self, timeout_s: float) -> memoryview | None:
        """Return the next sample's CDR, lent by Cyclone."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        while not self._waiter.interrupted:
            packed = self.reader.take()
            if packed is not None or not self._waiter.wait_until(deadline_ns):
                return packed
        return None

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the lent sample."""
        return deserialise(packed, self._type_name)


_domains: dict[int, tuple[Domain, str]] = {}
_domains_lock = Lock()


def _configure(domain_id: int, xml: str) -> None:
    """Configure a domain once per process; Cyclone takes no second configuration."""
    with _domains_lock:
        known = _domains.get(domain_id)
        if known is None:
            _domains[domain_id] = (Domain(domain_id, xml), xml)
        elif known[1] != xml:
            raise TransportError(f"DDS domain {domain_id} is already configured otherwise in this process")


class CycloneMiddleware:
    """One participant of a ROS 2 domain, from PyPI packages alone."""

    def __init__(self, domain_id: int, tuning: Tuning, node_name: str) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``; raises TransportError when Cyclone refuses."""
        self._domain_id = domain_id
        self._tuning = tuning
        self._xml = configuration(os.environ, tuning)
        try:
            if self._xml is not None:
                _configure(domain_id, self._xml)
            self._participant: DomainParticipant | None = DomainParticipant(
                domain_id, qos=Qos(Policy.Userdata(b"enclave=/;"))
            )
        except DDSException as error:
            raise TransportError(
                f"cannot join DDS domain {domain_id}: {error}; choose another with ROS_DOMAIN_ID, "
                "or check CYCLONEDDS_URI"
            ) from error
        self._servers: list[CycloneActionServer] = []
        self._services: CycloneServices | None = None
        atexit.register(self.close)
        self._node = NodeAnnouncement(self._participant, node_name)

    def publisher(self, topic: str, type_name: str, qos: QoS) -> _CyclonePublisher:
        """Create a writer on ``rt<topic>``."""
        publisher = _CyclonePublisher(self._joined(), topic, type_name, qos)
        self._node.add(publisher)
        return publisher

    def subscription(self, topic: str, type_name: str, qos: QoS) -> _CycloneSubscription:
        """Create a reader on ``rt<topic>``."""
        subscription = _CycloneSubscription(self._joined(), topic, type_name, qos)
        self._node.add(subscription.reader)
        return subscription

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Create a service; the first starts the thread that answers all."""
        self._services = self._services or CycloneServices(self._joined())
        self._node.add(*self._services.offer(name, type_name, answer, qos).ends())

    def service_client(self, name: str, type_name: str) -> CycloneServiceClient:
        """Create a client's two endpoints."""
        client = CycloneServiceClient(self._joined(), name, type_name)
        self._node.add(*client.ends())
        return client

    def action_client(self, name: str, type_name: str, version: str = DEFAULT_VERSION) -> CycloneActionClient:
        """Create a client's eight endpoints."""
        client = CycloneActionClient(self._joined(), name, type_name, version)
        self._node.add(*client.endpoints())
        return client

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> CycloneActionServer:
        """Create a server's eight endpoints and its service thread."""
        server = CycloneActionServer(self._joined(), name, type_name, result_timeout_s, version or DEFAULT_VERSION)
        self._servers.append(server)
        self._node.add(*server.endpoints())
        return server

    def describe(self) -> dict[str, str | int]:
        """Return which Cyclone, which domain, and the whole configuration."""
        return {
            "middleware": "cyclonedds",
            "version": package_version("cyclonedds"),
            "domain_id": self._domain_id,
            "tuning": self._tuning,
            "configuration": self._xml or os.environ.get("CYCLONEDDS_URI", ""),
        }

    def close(self) -> None:
        """Delete the participant, which tells peers at once that we leave."""
        if self._participant is not None:
            atexit.unregister(self.close)
            for server in self._servers:
                server.close()
            if self._services is not None:
                self._services.close()
            participant, self._participant = self._participant, None
            participant._delete(participant._ref)  # noqa: SLF001 - __del__ may come seconds later

    def _joined(self) -> DomainParticipant:
        if self._participant is None:
            raise TransportError("the middleware is closed")
        return self._participant
