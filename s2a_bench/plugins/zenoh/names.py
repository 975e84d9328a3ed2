"""The names of rmw_zenoh: key expressions, liveliness tokens, and the attachment of each message. No I/O.

After rmw_zenoh_cpp (``docs/design.md``, ``liveliness_utils.cpp``, ``attachment_helpers.cpp``) as Jazzy has it from
0.2.4 on, with 33 bytes of attachment; Humble's is the same without type hashes.
"""

from __future__ import annotations

import os
import struct
import time
from dataclasses import dataclass
from typing import Final

import xxhash

from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros.messages import dds_type_name, type_hash

ADMIN: Final = "@ros2_lv"
NODE, PUBLISHER, SUBSCRIPTION, SERVICE, CLIENT = "NN", "MP", "MS", "SS", "SC"
"""Kinds of entities."""
NO_HASH: Final = "TypeHashNotSupported"
"""Humble's."""
PARTS: Final = 13
"""The parts of the token of an endpoint."""
ATTACHMENT: Final = struct.Struct("<qqB16s")
"""Sequence number, source time in ns of ROS time, 16, and the sender's gid."""
BEST_EFFORT, TRANSIENT_LOCAL, KEEP_ALL = "2", "1", "2"
"""``rmw_qos_profile_t``'s numbers; the defaults are left out."""


@dataclass(frozen=True, slots=True)
class Entity:
    """An endpoint, as its liveliness token describes it."""

    kind: str
    name: str
    """The name with % for /; the root namespace is one %."""
    type_name: str
    """The type on the wire, such as ``sensor_msgs::msg::dds_::Image_``."""
    type_hash: str


def wire_hash(type_name: str, version: str) -> str:
    """Return the type hash in keys; the type of a service is the service itself, neither of its halves."""
    return NO_HASH if os.environ.get("ROS_DISTRO") == "humble" else type_hash(type_name, version)


def key(domain_id: int, name: str, type_name: str, hashed: str) -> str:
    """Return the key expression of a topic or service ``/name`` of ROS type ``pkg/kind/Name``."""
    return f"{domain_id}/{name.strip('/')}/{dds_type_name(type_name)}/{hashed}"


def qos_text(qos: QoS) -> str:
    """Return a QoS as tokens have it: ROS's defaults are empty, the depth is always given."""
    history = f",{qos.depth}" if qos.depth else f"{KEEP_ALL},"
    seconds, nanoseconds = divmod(round(qos.lifespan_s * 1e9), 1_000_000_000)
    lifespan = f"{seconds},{nanoseconds}" if qos.lifespan_s else ","
    reliability = "" if qos.reliable else BEST_EFFORT
    durability = TRANSIENT_LOCAL if qos.latched else ""
    return f"{reliability}:{durability}:{history}:,:{lifespan}:,,"


def node_token(domain_id: int, session: str, node_name: str) -> str:
    return _token(domain_id, session, 0, NODE, node_name)


def endpoint_token(domain_id: int, session: str, number: int, node_name: str, entity: Entity, qos: QoS) -> str:
    head = _token(domain_id, session, number, entity.kind, node_name)
    return f"{head}/{entity.name}/{entity.type_name}/{entity.type_hash}/{qos_text(qos)}"


def _token(domain_id: int, session: str, number: int, kind: str, node_name: str) -> str:
    namespace, _, name = node_name.rpartition("/")
    return f"{ADMIN}/{domain_id}/{session}/0/{number}/{kind}/%/{(namespace or '/').replace('/', '%')}/{name}"


def entity_of(token: str) -> Entity | None:
    """Read the token of an endpoint; None for a node's, and for anything else."""
    parts = token.split("/")
    if len(parts) != PARTS or parts[0] != ADMIN:
        return None
    kind, name, type_name, hashed = parts[5], *parts[9:12]
    return Entity(kind, name, type_name, hashed) if name.startswith("%") else None


def session_of(token: str) -> str:
    """Return the session that declared a token, as `entity_of` reads it."""
    return token.split("/")[2]


def gid_of(token: str) -> bytes:
    """Return an endpoint's gid: XXH3-128 of its token, the low half first."""
    return int.to_bytes(xxhash.xxh3_128_intdigest(token.encode()), 16, "little")


def attachment(sequence: int, gid: bytes) -> bytes:
    """Return the attachment of a message that is sent now; of a reply, that of its request but for the time."""
    return ATTACHMENT.pack(sequence, time.time_ns(), len(gid), gid)


def attached(data: bytes) -> tuple[int, int, bytes]:
    """Read an attachment: (sequence number, source time, gid); raises TransportError for a malformed one."""
    if len(data) == ATTACHMENT.size:
        sequence, source_ns, size, gid = ATTACHMENT.unpack(data)
        if size == len(gid):
            return sequence, source_ns, gid
    raise TransportError(
        f"{len(data)} bytes of attachment, where rmw_zenoh 0.2.4 and later have {ATTACHMENT.size}: update the peer"
    )
