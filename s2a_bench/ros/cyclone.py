"""The middleware on Cyclone DDS from PyPI: ready CDR in, views of the received CDR out, ROS 2 names outside."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cached_property
from importlib.metadata import version as package_version
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.qos import Policy, Qos

from s2a_bench.errors import TransportError
from s2a_bench.ros import Offer, QoS, Tuning
from s2a_bench.ros import messages as ros
from s2a_bench.ros.action import ActionNode
from s2a_bench.ros.config import configuration
from s2a_bench.ros.dds import DdsWaiter, RawReader, RawWriter, dds_qos, is_described, writers_of
from s2a_bench.ros.dds_service import Caller, DdsServiceClient, DdsServiceServer
from s2a_bench.ros.messages import DEFAULT_VERSION, deserialise, serialise, type_hash
from s2a_bench.ros.remap import check_node_name
from s2a_bench.ros.service import ServiceSpec, awaited

PARTICIPANT_ENTITIES = "rmw_dds_common/msg/ParticipantEntitiesInfo"
NODE_ENTITIES = "rmw_dds_common/msg/NodeEntitiesInfo"
BEST_EFFORT = Policy.Reliability.BestEffort
GID = "rmw_dds_common/msg/Gid"
UNTYPED = "typehash_unknown=;"
"""Announced for a type that we do not know; ROS matches by name, and says nothing about it."""


def _gid(guid: bytes) -> Any:
    """Make a Gid of a DDS GUID; Humble's has 8 bytes more."""
    gid = ros.default(GID)
    gid.data[: len(guid)] = np.frombuffer(guid, np.uint8)
    return gid


class NodeAnnouncement:
    """One node of one participant and all its endpoints; callable from any thread."""

    def __init__(self, participant: DomainParticipant, node_name: str) -> None:
        """Announce ``node_name`` (``/namespace/name``) without endpoints; raises UsageError for an invalid name."""
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
    has_definition = type_name in ros.typestore(version).fielddefs
    return dds_qos(qos, f"typehash={type_hash(type_name, version)};" if has_definition else UNTYPED)


class _CyclonePublisher(RawWriter):
    def __init__(self, participant: DomainParticipant, topic: str, type_name: str, qos: QoS, version: str) -> None:
        super().__init__(participant, "rt" + topic, type_name, _topic_qos(qos, type_name, version))

    def pack(self, message: Any) -> bytearray:
        return serialise(message, self._type_name)


class _CycloneSubscription:
    def __init__(self, reader: RawReader, topic: str, type_name: str, version: str, waiter: DdsWaiter) -> None:
        self.reader, self.topic, self._type_name, self._version = reader, topic, type_name, version
        self._waiter = waiter
        waiter.watch(reader)
        self.interrupt, self.arrived, self.sender = waiter.interrupt, reader.arrived, reader.sender
        self.matched = self.announced = reader.matched

    def take(self, timeout_s: float) -> memoryview | None:
        return awaited(self.reader.take, self._waiter, timeout_s)

    def sender_hears(self, sender: int, publisher: RawWriter) -> bool:
        client = self.reader.endpoint(sender)
        return client is None or any(each.participant_key == client.participant_key for each in publisher.endpoints())

    def unpack(self, packed: memoryview) -> Any:
        return deserialise(packed, self._type_name, self._version)


_domains: dict[int, tuple[Domain, str]] = {}
_domains_lock = Lock()


def _configure(domain_id: int, xml: str) -> None:
    """Configure a domain once per process; Cyclone takes no second configuration."""
    with _domains_lock:
        joined = _domains.get(domain_id)
        if joined is None:
            _domains[domain_id] = (Domain(domain_id, xml), xml)
        elif joined[1] != xml:
            raise TransportError(f"DDS domain {domain_id} is already configured otherwise in this process")


class CycloneMiddleware(ActionNode[Caller, DdsWaiter]):
    def __init__(self, domain_id: int, tuning: Tuning, node_name: str) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``; raises TransportError when Cyclone refuses."""
        self._domain_id = domain_id
        self._tuning = tuning
        self._xml = configuration(os.environ, tuning)
        try:
            if self._xml is not None:
                _configure(domain_id, self._xml)
            # the USER_DATA of every ROS participant
            self._participant = DomainParticipant(domain_id, qos=Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise TransportError(
                f"cannot join DDS domain {domain_id}: {error}; choose another with ROS_DOMAIN_ID, "
                "or check CYCLONEDDS_URI"
            ) from error
        super().__init__()
        self._node = NodeAnnouncement(self._participant, node_name)

    def waiter(self) -> DdsWaiter:
        self.check_open()
        return DdsWaiter(self._participant)

    def publisher(self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION) -> _CyclonePublisher:
        self.check_open()
        publisher = _CyclonePublisher(self._participant, topic, type_name, qos, version)
        self._node.add(publisher)
        return publisher

    def subscription(
        self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION, waiter: DdsWaiter | None = None
    ) -> _CycloneSubscription:
        """Subscribe; to a camera without ROS that describes its type only where it is one of `offers` already."""
        waiter = waiter or self.waiter()
        camera = type_name in {ros.IMAGE, ros.COMPRESSED_IMAGE}  # reading all writers takes 70 us for each of them
        described = camera and any(w.topic_name == "rt" + topic and is_described(w, type_name) for w in self._writers())
        topic_qos = _topic_qos(qos, type_name, version)
        reader = RawReader(self._participant, "rt" + topic, type_name, topic_qos, described=described)
        self._node.add(reader)
        return _CycloneSubscription(reader, topic, type_name, version, waiter)

    @cached_property
    def _writers(self) -> Callable[[], list[Any]]:
        return writers_of(self._participant)

    def offers(self) -> list[Offer]:
        return [
            Offer(w.topic_name[2:], ros.ros_type_name(w.type_name), w.qos[Policy.Reliability] != BEST_EFFORT)
            for w in self._writers()
            if w.topic_name.startswith("rt/")
        ]

    def service_end(self, spec: ServiceSpec, waiter: DdsWaiter, qos: QoS | None = None) -> DdsServiceServer:
        server = DdsServiceServer(self._participant, spec, waiter, qos)
        self._node.add(*server.ends)
        return server

    def client_end(self, spec: ServiceSpec, waiter: DdsWaiter) -> DdsServiceClient:
        client = DdsServiceClient(self._participant, spec, waiter)
        self._node.add(*client.ends)
        return client

    def describe(self) -> dict[str, str | int]:
        return {
            "middleware": "cyclonedds",
            "version": package_version("cyclonedds"),
            "domain_id": self._domain_id,
            "tuning": self._tuning,
            "configuration": self._xml or os.environ.get("CYCLONEDDS_URI", ""),
        }

    def leave(self) -> None:
        participant = self._participant
        del self._participant  # with it goes what nothing else refers to
        # without this ROS would list the node until its lease of 10 s ends
        participant._delete(participant._ref)  # noqa: SLF001 - __del__ may come seconds later
