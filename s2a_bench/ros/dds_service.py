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
from types import SimpleNamespace
from typing import Any, ClassVar

from cyclonedds.domain import DomainParticipant

from s2a_bench.clock import now_ns
from s2a_bench.ros import SERVICE_QOS, QoS
from s2a_bench.ros.dds import DdsWaiter, RawReader, RawWriter, dds_qos, other_dds, user_data
from s2a_bench.ros.messages import deserialise, serialise, type_hash
from s2a_bench.ros.service import MATCH_POLL_S, REACH_S, READER_QOS, ServiceEnd, ServiceSpec

HEADER = struct.Struct("<Qq")
"""guid of the client and number of its request, after the 4 bytes of CDR header."""
HEADER_AT = 4

REPLY_QOS = QoS(depth=1000)
"""Deeper than ROS's 10: all clients' replies share one writer, and one that was lost on the way can be sent again."""

_numbers = count(8)


def endpoint_id(prefix: bytes, number: int) -> str:
    """Write an id as rmw_cyclonedds does: GUID prefix and number as hex bytes without zeros, the first padded."""
    data = prefix + number.to_bytes(4, "big")
    return f"{data[0]:2x}" + "".join(f".{byte:x}" for byte in data[1:])


@dataclass(frozen=True, slots=True)
class Caller:
    """The writer of a request, and the request's header, which its reply repeats."""

    sender: int
    header: tuple[int, int]


class _End:
    body_at = HEADER_AT + HEADER.size
    serves: ClassVar[bool]
    """Whether it is the server's side, which takes requests and sends replies."""

    def __init__(
        self, participant: DomainParticipant, spec: ServiceSpec, waiter: DdsWaiter, qos: QoS | None = None
    ) -> None:
        """Create both endpoints of a service; without ``qos`` they have that of an action's."""
        self.spec = spec
        identity = endpoint_id(participant.get_guid().bytes[:12], next(_numbers))
        request, reply = (f"rq{spec.name}Request", spec.request_type), (f"rr{spec.name}Reply", spec.reply_type)
        sent, received = (reply, request) if self.serves else (request, reply)
        own, self._peer_key = ("serviceid", "clientid") if self.serves else ("clientid", "serviceid")

        def announced(type_name: str) -> str:
            return f"{own}={identity};typehash={type_hash(type_name, spec.version)};"

        writer_qos = qos or (SERVICE_QOS if sent is request else REPLY_QOS)
        self.writer = RawWriter(participant, *sent, dds_qos(writer_qos, announced(sent[1])))
        self.reader = RawReader(participant, *received, dds_qos(qos or READER_QOS, announced(received[1])))
        waiter.watch(self.reader)
        self.ends = self.writer, self.reader
        self._sent_wire, self._received_wire = sent[1] + "__wire", received[1] + "__wire"

    @property
    def hashed_type(self) -> str:
        return self.spec.request_type

    def matched(self) -> bool:
        ids = [{announced.get(self._peer_key) for announced in map(user_data, end.endpoints())} for end in self.ends]
        return bool((ids[0] & ids[1]) - {None})

    def other_dds(self) -> str:
        return next((name for end in self.ends for endpoint in end.endpoints() if (name := other_dds(endpoint))), "")

    def peer_type_hash(self) -> str:
        hashes = (user_data(endpoint).get("typehash", "") for endpoint in self.writer.endpoints())
        return next(filter(None, hashes), "")

    def pack(self, body: Any) -> bytearray:
        return serialise(SimpleNamespace(guid=0, seq=0, body=body), self._sent_wire, self.spec.version)

    def unpack(self, packed: memoryview) -> Any:
        return deserialise(packed, self._received_wire, self.spec.version).body


class DdsServiceClient(_End):
    serves = False

    def __init__(self, participant: DomainParticipant, spec: ServiceSpec, waiter: DdsWaiter) -> None:
        super().__init__(participant, spec, waiter)
        self._guid = self.writer.entity.get_instance_handle() % 2**64  # as rmw_cyclonedds; any but 0 would do
        self._numbers = count(1)
        self._pending: dict[int, bytes] = {}
        self._lock = Lock()

    def call(self, packed: bytearray, key: bytes) -> None:
        with self._lock:  # any thread may call
            number = next(self._numbers)
            self._pending[number] = key  # before it is sent: the reply may be there at once
            HEADER.pack_into(packed, HEADER_AT, self._guid, number)
            self.writer.send(packed)

    def replies(self) -> Iterator[tuple[bytes, memoryview]]:
        for packed in self.reader.arrived():
            if len(packed) <= self.body_at:
                continue
            guid, number = HEADER.unpack_from(packed, HEADER_AT)
            if guid == self._guid and (key := self._pending.pop(number, None)) is not None:
                yield key, packed


class DdsServiceServer(_End, ServiceEnd[Caller]):
    serves = True

    def __init__(
        self, participant: DomainParticipant, spec: ServiceSpec, waiter: DdsWaiter, qos: QoS | None = None
    ) -> None:
        super().__init__(participant, spec, waiter, qos)
        self._reachable: set[int] = set()
        self._clients: dict[int, tuple[str, str]] = {}

    def arrived(self) -> Iterator[tuple[memoryview, Caller]]:
        """Take the samples that have arrived, a bounded number; the header of one too short to have one is zero."""
        for packed in self.reader.arrived():
            header = HEADER.unpack_from(packed, HEADER_AT) if len(packed) >= self.body_at else (0, 0)
            yield packed, Caller(self.reader.sender(), header)

    def respond(self, packed: bytearray, caller: Caller) -> None:
        HEADER.pack_into(packed, HEADER_AT, *caller.header)
        self.writer.send(packed)

    def client(self, caller: Caller) -> tuple[str, str]:
        """Return a client's other DDS and the type hash it announces, "" where unknown; kept, as they never change."""
        if caller.sender not in self._clients:
            endpoint = self.reader.endpoint(caller.sender)
            if endpoint is None:
                return "", ""
            self._clients[caller.sender] = other_dds(endpoint), user_data(endpoint).get("typehash", "")
        return self._clients[caller.sender]

    def reaches(self, caller: Caller) -> bool:
        """Wait, 100 ms at most, until replies reach the client.

        A reply is volatile: sent before the client's reader is matched, it is lost. False if the client has left.
        """
        if caller.sender in self._reachable:
            return True
        deadline_ns = now_ns() + round(REACH_S * 1e9)
        while (endpoint := self.reader.endpoint(caller.sender)) is not None:
            client = user_data(endpoint).get("clientid")
            if client is None or any(user_data(each).get("clientid") == client for each in self.writer.endpoints()):
                self._reachable.add(caller.sender)
                return True
            if now_ns() > deadline_ns:
                return True  # as rmw_cyclonedds: send all the same
            time.sleep(MATCH_POLL_S)
        return False
