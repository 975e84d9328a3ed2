"""The middleware on Cyclone DDS from PyPI: ready CDR in, views of the received CDR out, ROS 2 names outside."""

from __future__ import annotations

import atexit
import logging
import os
from collections.abc import Callable
from importlib.metadata import version as package_version
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.qos import Policy, Qos

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import SERVICE_QOS, QoS, Tuning
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import CANCEL_GOAL, FEEDBACK_QOS, STATUS_ARRAY, STATUS_QOS, ClientAction, ServedAction
from s2a_bench.ros.config import configuration
from s2a_bench.ros.dds import DdsWaiter, RawReader, RawWriter, dds_qos
from s2a_bench.ros.dds_service import Caller, DdsServiceClient, DdsServiceServer
from s2a_bench.ros.messages import DEFAULT_VERSION, deserialise, serialise, type_hash
from s2a_bench.ros.remap import check_node_name
from s2a_bench.ros.service import READER_QOS, Calling, Services

PARTICIPANT_ENTITIES = "rmw_dds_common/msg/ParticipantEntitiesInfo"
NODE_ENTITIES = "rmw_dds_common/msg/NodeEntitiesInfo"
GID = "rmw_dds_common/msg/Gid"

_log = logging.getLogger(__name__)


def _gid(guid: bytes) -> Any:
    """Make a Gid of a DDS GUID; Humble's has 8 bytes more."""
    gid = ros.default(GID)
    gid.data[: len(guid)] = np.frombuffer(guid, np.uint8)
    return gid


class NodeAnnouncement:
    """One node of one participant and all its endpoints; callable from any thread."""

    def __init__(self, participant: DomainParticipant, node_name: str) -> None:
        """Announce ``node_name`` (``/namespace/name``) without endpoints; raises UsageError for what is no name."""
        check_node_name(node_name)
        namespace, _, self._name = node_name.rpartition("/")
        self._namespace = namespace or "/"
        self._participant = _gid(participant.get_guid().bytes)
        self._gids: WeakKeyDictionary[RawReader | RawWriter, Any] = WeakKeyDictionary()
        self._lock = Lock()
        qos = _topic_qos(QoS(depth=1, latched=True), PARTICIPANT_ENTITIES)
        self._writer = RawWriter(participant, "ros_discovery_info", PARTICIPANT_ENTITIES, qos)
        self.add()

    def add(self, *endpoints: RawReader | RawWriter) -> None:
        """Add endpoints and publish the whole again, less those that are no longer used."""
        with self._lock:
            self._gids.update((endpoint, _gid(endpoint.entity.get_guid().bytes)) for endpoint in endpoints)
            node = ros.message(
                NODE_ENTITIES,
                node_namespace=self._namespace,
                node_name=self._name,
                reader_gid_seq=[gid for endpoint, gid in self._gids.items() if isinstance(endpoint, RawReader)],
                writer_gid_seq=[gid for endpoint, gid in self._gids.items() if isinstance(endpoint, RawWriter)],
            )
            info = ros.message(PARTICIPANT_ENTITIES, gid=self._participant, node_entities_info_seq=[node])
            self._writer.send(ros.serialise(info, PARTICIPANT_ENTITIES))


def _topic_qos(qos: QoS, type_name: str, version: str = DEFAULT_VERSION) -> Qos:
    return dds_qos(qos, f"typehash={type_hash(type_name, version)};")


def _reader(
    participant: DomainParticipant, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION
) -> RawReader:
    return RawReader(participant, "rt" + topic, type_name, _topic_qos(qos, type_name, version))


class _CyclonePublisher(RawWriter):
    def __init__(
        self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION
    ) -> None:
        super().__init__(participant, "rt" + topic, type_name, _topic_qos(qos, type_name, version))

    def pack(self, message: Any) -> bytearray:
        return serialise(message, self._type_name)


class _CycloneSubscription:
    """Receives messages from a ROS topic, on the consuming thread."""

    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS) -> None:
        self.topic, self._type_name = topic, type_name
        self.reader = _reader(participant, topic, type_name, qos)
        self._waiter = DdsWaiter(participant, [self.reader])
        self.interrupt = self._waiter.interrupt
        self.matched, self.publishers = self.reader.matched, self.reader.publishers

    def take(self, timeout_s: float) -> memoryview | None:
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        while not self._waiter.interrupted:
            packed = self.reader.take()
            if packed is not None or not self._waiter.wait_until(deadline_ns):
                return packed
        return None

    def unpack(self, packed: memoryview) -> Any:
        return deserialise(packed, self._type_name)


class CycloneActionClient(ClientAction):
    """Waits for all readers at once."""

    _goals: DdsServiceClient

    def __init__(self, participant: DomainParticipant, name: str, type_name: str, version: str) -> None:
        prefix = name + "/_action/"
        feedback = _reader(participant, prefix + "feedback", type_name + "_FeedbackMessage", READER_QOS, version)
        status = _reader(participant, prefix + "status", STATUS_ARRAY, STATUS_QOS)
        """Not read: a goal's status comes with its result. ROS tools expect a client to subscribe."""
        # Readers are announced in order: a server that knows the reply readers below knows the feedback reader too.
        goals = DdsServiceClient(participant, prefix + "send_goal", type_name + "_SendGoal", version)
        results = DdsServiceClient(participant, prefix + "get_result", type_name + "_GetResult", version)
        cancels = DdsServiceClient(participant, prefix + "cancel_goal", CANCEL_GOAL, version)
        waiter = DdsWaiter(participant, [goals.reader, results.reader, cancels.reader, feedback])
        topics = feedback.matched, status.matched
        super().__init__(type_name, version, (goals, results, cancels), feedback.arrived, topics, waiter)
        self.ends = (*goals.ends, *results.ends, *cancels.ends, feedback, status)

    def other_dds(self) -> str:
        return self._goals.other_dds()


class CycloneActionServer(ServedAction[Caller]):
    """Looks at what a client announces."""

    send_goal: DdsServiceServer

    def __init__(
        self, participant: DomainParticipant, name: str, type_name: str, result_timeout_s: float, version: str
    ) -> None:
        prefix = name + "/_action/"
        goals = DdsServiceServer(participant, prefix + "send_goal", type_name + "_SendGoal", version)
        results = DdsServiceServer(participant, prefix + "get_result", type_name + "_GetResult", version)
        cancels = DdsServiceServer(participant, prefix + "cancel_goal", CANCEL_GOAL, version)
        feedback_type = type_name + "_FeedbackMessage"
        feedback = _CyclonePublisher(participant, prefix + "feedback", feedback_type, FEEDBACK_QOS, version)
        status = _CyclonePublisher(participant, prefix + "status", STATUS_ARRAY, STATUS_QOS)
        self._warned: set[str] = set()
        self.ends = (*goals.ends, *results.ends, *cancels.ends, feedback, status)
        waiters = DdsWaiter(participant, [goals.reader]), DdsWaiter(participant, [results.reader, cancels.reader])
        services, senders = (goals, results, cancels), (feedback.send, status.send)
        super().__init__(name, type_name, result_timeout_s, version, services, senders, waiters)

    def announced(self, caller: Caller) -> str:
        return self.send_goal.client(caller)[1]

    def _understood(self, caller: Caller) -> bool:
        """Log once that a client is there whose requests cannot be read, and which will hear nothing."""
        other, _ = self.send_goal.client(caller)
        if other and other not in self._warned:
            self._warned.add(other)
            _log.warning(
                "%s: a client on %s waits in vain, as its services have another form on the wire: start it with "
                "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp, or serve in a sourced ROS 2 of its RMW (--middleware rclpy)",
                self._name,
                other,
            )
        return not other


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
        self._requests = DdsWaiter(self._participant, [])
        self._services: Services[Caller] | None = None
        atexit.register(self.close)
        self._node = NodeAnnouncement(self._participant, node_name)

    def publisher(self, topic: str, type_name: str, qos: QoS) -> _CyclonePublisher:
        publisher = _CyclonePublisher(self._joined(), topic, type_name, qos)
        self._node.add(publisher)
        return publisher

    def subscription(self, topic: str, type_name: str, qos: QoS) -> _CycloneSubscription:
        subscription = _CycloneSubscription(self._joined(), topic, type_name, qos)
        self._node.add(subscription.reader)
        return subscription

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Create a service; the first starts the thread that answers all."""
        server = DdsServiceServer(self._joined(), name, type_name, DEFAULT_VERSION, qos)
        self._services = self._services or Services(self._requests)
        self._services.offer(name, server, answer)
        self._requests.watch(server.reader)
        self._node.add(*server.ends)

    def service_client(self, name: str, type_name: str) -> Calling:
        client = DdsServiceClient(self._joined(), name, type_name, DEFAULT_VERSION)
        self._node.add(*client.ends)
        return Calling(name, client, DdsWaiter(self._joined(), [client.reader]))

    def action_client(self, name: str, type_name: str, version: str = DEFAULT_VERSION) -> CycloneActionClient:
        client = CycloneActionClient(self._joined(), name, type_name, version)
        self._node.add(*client.ends)
        return client

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> CycloneActionServer:
        server = CycloneActionServer(self._joined(), name, type_name, result_timeout_s, version or DEFAULT_VERSION)
        self._servers.append(server)
        self._node.add(*server.ends)
        return server

    def describe(self) -> dict[str, str | int]:
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
