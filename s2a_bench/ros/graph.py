"""Announces our node on ``ros_discovery_info``, so that ROS tools list its endpoints by name."""

from __future__ import annotations

import re
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from cyclonedds.domain import DomainParticipant

from s2a_bench.errors import UsageError
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.dds import RawReader, RawWriter, dds_qos

PARTICIPANT_ENTITIES = "rmw_dds_common/msg/ParticipantEntitiesInfo"
NODE_ENTITIES = "rmw_dds_common/msg/NodeEntitiesInfo"
GID = "rmw_dds_common/msg/Gid"
NODE_NAME = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)


def _gid(guid: bytes) -> Any:
    """Make a Gid of a DDS GUID; Humble's has 8 bytes more."""
    gid = ros.default(GID)
    gid.data[: len(guid)] = np.frombuffer(guid, np.uint8)
    return gid


class NodeAnnouncement:
    """One node of one participant and all its endpoints; callable from any thread."""

    def __init__(self, participant: DomainParticipant, node_name: str) -> None:
        """Announce ``node_name`` (``/namespace/name``) without endpoints; raises UsageError for what is no name."""
        if not NODE_NAME.fullmatch(node_name):
            raise UsageError(f"node name '{node_name}': write it as /name or /namespace/name, letters, digits and _")
        namespace, _, self._name = node_name.rpartition("/")
        self._namespace = namespace or "/"
        self._participant = _gid(participant.get_guid().bytes)
        self._readers: WeakKeyDictionary[RawReader, Any] = WeakKeyDictionary()
        self._writers: WeakKeyDictionary[RawWriter, Any] = WeakKeyDictionary()
        self._lock = Lock()
        user_data = f"typehash={ros.type_hash(PARTICIPANT_ENTITIES)};"
        qos = dds_qos(QoS(depth=1, latched=True), user_data)
        self._writer = RawWriter(participant, "ros_discovery_info", PARTICIPANT_ENTITIES, qos)
        self.add()

    def add(self, *endpoints: RawReader | RawWriter) -> None:
        """Add endpoints and publish the whole again, less those that are no longer used."""
        with self._lock:
            for endpoint in endpoints:
                gid = _gid(endpoint.entity.get_guid().bytes)
                if isinstance(endpoint, RawReader):
                    self._readers[endpoint] = gid
                else:
                    self._writers[endpoint] = gid
            node = ros.message(
                NODE_ENTITIES,
                node_namespace=self._namespace,
                node_name=self._name,
                reader_gid_seq=list(self._readers.values()),
                writer_gid_seq=list(self._writers.values()),
            )
            info = ros.message(PARTICIPANT_ENTITIES, gid=self._participant, node_entities_info_seq=[node])
            self._writer.send(ros.serialise(info, PARTICIPANT_ENTITIES))
