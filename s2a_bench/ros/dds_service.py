"""The two ends of a ROS 2 service as rmw_cyclonedds_cpp sends it: a header before the body, ids in USER_DATA.

Every client receives every reply and keeps those whose header carries its own guid; the ids in USER_DATA say which
request and reply endpoints belong together.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from threading import Lock
from typing import Any

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros.dds import RawReader, RawWriter, dds_qos, other_dds, user_data
from s2a_bench.ros.messages import deserialise, serialise, type_hash

HEADER = struct.Struct("<Qq")
"""guid of the client and number of its request, after the 4 bytes of CDR header."""
HEADER_AT = 4
BODY_AT = 20

REQUEST_QOS = QoS(depth=10)
"""What ROS's services have; a request may hold pictures."""
REPLY_QOS = QoS(depth=1000)
"""Deeper than ROS's 10: all clients' replies share one writer, and one that was lost on the way can be sent again."""
READER_QOS = QoS(depth=0)
"""Our readers keep all, whatever ROS does: history is local, and a burst overruns ROS's default of 10."""

REPLY_READER_TIMEOUT_NS = 100_000_000
REPLY_READER_POLL_S = 0.01
REMEMBERED_CLIENTS = 64

_numbers = count(8)


def endpoint_id(prefix: bytes, number: int) -> str:
    """Write an id as rmw_cyclonedds does: GUID prefix and number as hex bytes without zeros, the first padded."""
    data = prefix + number.to_bytes(4, "big")
    return f"{data[0]:2x}" + "".join(f".{byte:x}" for byte in data[1:])


@dataclass(frozen=True, slots=True)
class Peer:
    """What a client's writer announces; "" is not known."""

    other_dds: str = ""
    """Of which DDS it is, where its services have another form than ours."""
    type_hash: str = ""


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asked: the writer of a request, and the request's header, under which its reply goes."""

    sender: int
    header: tuple[int, int]


class _End:
    """What client and server have in common."""

    def __init__(
        self,
        participant: DomainParticipant,
        name: str,
        type_name: str,
        version: str,
        role: tuple[str, str],
        qos: QoS | None = None,
    ) -> None:
        """Create both endpoints; ``qos`` is that of both, None that of an action's services."""
        own, self._peer_key = role
        self.request_type, self.reply_type = type_name + "_Request", type_name + "_Response"
        self._version = version
        identity = endpoint_id(participant.get_guid().bytes[:12], next(_numbers))
        request, reply = ("rq" + name + "Request", self.request_type), ("rr" + name + "Reply", self.reply_type)
        sent, received = (request, reply) if own == "clientid" else (reply, request)

        def told(type_name: str) -> str:
            return f"{own}={identity};typehash={type_hash(type_name, version)};"

        writer_qos = qos or (REQUEST_QOS if sent is request else REPLY_QOS)
        self.writer = RawWriter(participant, *sent, dds_qos(writer_qos, told(sent[1])))
        self.reader = RawReader(participant, *received, dds_qos(qos or READER_QOS, told(received[1])))

    def matched(self) -> bool:
        """Return whether both endpoints of one peer are matched."""
        ids = [{peer[self._peer_key] for peer in end.peers() if self._peer_key in peer} for end in self.ends()]
        return bool(ids[0] & ids[1])

    def ends(self) -> tuple[RawWriter, RawReader]:
        """Return both endpoints."""
        return self.writer, self.reader

    def other_dds(self) -> str:
        """Return the DDS of a peer whose services have another form than `rmw_cyclonedds_cpp`'s, "" without one."""
        return next((name for end in self.ends() for endpoint in end.endpoints() if (name := other_dds(endpoint))), "")

    def peer_type_hash(self) -> str:
        """Return the type hash a peer announces for what it reads; empty without one."""
        return next((peer["typehash"] for peer in self.writer.peers() if "typehash" in peer), "")


class ServiceClient(_End):
    """Sends requests and finds the replies that are its own."""

    def __init__(self, participant: DomainParticipant, name: str, type_name: str, version: str) -> None:
        """Create both endpoints of the service ``/name``."""
        super().__init__(participant, name, type_name, version, ("clientid", "serviceid"))
        self.hashed_type = self.request_type
        self._guid = self.writer.entity.get_instance_handle() % 2**64
        self._numbers = count(1)
        self._pending: dict[int, bytes] = {}
        self._lock = Lock()

    def pack(self, body: Any) -> bytearray:
        """Serialise a request; `call` fills its header in."""
        wire = self.request_type + "__wire"
        return serialise(_Wire(0, 0, body), wire, self._version)

    def call(self, packed: bytearray, goal_id: bytes) -> None:
        """Send a request that concerns ``goal_id``."""
        with self._lock:
            number = next(self._numbers)
            self._pending[number] = goal_id
            HEADER.pack_into(packed, HEADER_AT, self._guid, number)
            self.writer.send(packed)

    def replies(self) -> Iterator[tuple[bytes, memoryview]]:
        """Take what has arrived, a bounded number, and yield the replies to requests of ours: (goal id, CDR)."""
        for packed in self.reader.arrived():
            if len(packed) <= BODY_AT:
                continue
            guid, number = HEADER.unpack_from(packed, HEADER_AT)
            if guid == self._guid and (goal_id := self._pending.pop(number, None)) is not None:
                yield goal_id, packed

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise a reply's body; raises TransportError."""
        return deserialise(packed, self.reply_type + "__wire", self._version).body


class ServiceServer(_End):
    """Takes requests and sends replies to who asked."""

    def __init__(
        self, participant: DomainParticipant, name: str, type_name: str, version: str, qos: QoS | None = None
    ) -> None:
        """Create both endpoints of the service ``/name``; ``qos`` as for `_End`."""
        super().__init__(participant, name, type_name, version, ("serviceid", "clientid"), qos)
        self._reachable: set[int] = set()
        self._clients: dict[int, Peer] = {}

    def pack(self, body: Any) -> bytearray:
        """Serialise a reply; `reply` fills its header in."""
        return serialise(_Wire(0, 0, body), self.reply_type + "__wire", self._version)

    def reply(self, packed: bytearray, header: tuple[int, int]) -> None:
        """Send a reply under the header of its request."""
        HEADER.pack_into(packed, HEADER_AT, *header)
        self.writer.send(packed)

    def caller(self, packed: memoryview) -> Caller:
        """Return who sent the request that was taken last; of one that is too short for a header, nobody's."""
        header = HEADER.unpack_from(packed, HEADER_AT) if len(packed) >= BODY_AT else (0, 0)
        return Caller(self.reader.sender(), header)

    def respond(self, packed: bytearray, caller: Caller) -> None:
        """Send a reply to who asked."""
        self.reply(packed, caller.header)

    def reaches(self, caller: Caller) -> bool:
        """Wait until replies reach who asked."""
        return self.await_client(caller.sender)

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise a request's body; raises TransportError."""
        return deserialise(packed, self.request_type + "__wire", self._version).body

    def client(self, sender: int) -> Peer:
        """Return what the writer ``sender`` announced, asked once: it stays as it is; nothing if it has left."""
        found = self._clients.get(sender)
        if found is None:
            endpoint = self.reader.endpoint(sender)
            if endpoint is None:
                return Peer()
            if len(self._clients) >= REMEMBERED_CLIENTS:
                self._clients.clear()
            found = self._clients[sender] = Peer(other_dds(endpoint), user_data(endpoint).get("typehash", ""))
        return found

    def await_client(self, sender: int) -> bool:
        """Wait, 100 ms at most, until replies reach the client whose request came from writer ``sender``.

        A reply is volatile: sent before the client's reader is matched, it is lost. False if the client has left.
        """
        if sender in self._reachable:
            return True
        deadline_ns = now_ns() + REPLY_READER_TIMEOUT_NS
        while (peer := self.reader.peer(sender)) is not None:
            client = peer.get("clientid")
            if client is None or any(reader.get("clientid") == client for reader in self.writer.peers()):
                if len(self._reachable) >= REMEMBERED_CLIENTS:
                    self._reachable.intersection_update(self.reader.senders())
                self._reachable.add(sender)
                return True
            if now_ns() > deadline_ns:
                return True  # as rmw_cyclonedds: send, whoever may hear it
            time.sleep(REPLY_READER_POLL_S)
        return False


class _Wire:
    """A body behind its header, as the ``__wire`` types want it."""

    __slots__ = ("body", "guid", "seq")

    def __init__(self, guid: int, seq: int, body: Any) -> None:
        self.guid, self.seq, self.body = guid, seq, body
