"""Topics over Zenoh as rmw_zenoh has them: CDR with an attachment; latched ones are cached by their publisher."""

from __future__ import annotations

import logging
import time
from itertools import count
from typing import Any, Final
from weakref import ref

import zenoh
from zenoh import ext

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import QoS
from s2a_bench.ros import zenoh_names as names
from s2a_bench.ros.messages import DEFAULT_VERSION, deserialise, serialise
from s2a_bench.ros.zenoh_inbox import Bell, Inbox
from s2a_bench.ros.zenoh_node import Node, direct, give_way, refusals

CACHED_AT_MOST: Final = 1000
"""What a latched topic that keeps all keeps."""
PADDING_AT: Final = 3
"""In the CDR header."""

_log = logging.getLogger(__name__)


def plain_cdr(packed: bytearray) -> bytearray:
    """Take off the padding that DDS wants behind CDR, and rmw_zenoh's Fast CDR does not write."""
    if padding := packed[PADDING_AT]:
        del packed[-padding:]
        packed[PADDING_AT] = 0
    return packed


class Stamps:
    """Makes the attachments of one endpoint's messages."""

    def __init__(self, gid: bytes) -> None:
        """Begin with 1."""
        self._gid = gid
        self._numbers = count(1)

    def next(self) -> bytes:
        """Return the next message's."""
        return names.ATTACHMENT.pack(next(self._numbers), time.time_ns(), len(self._gid), self._gid)


class ZenohPublisher:
    """Sends messages of one type to one topic; callable from any thread."""

    def __init__(self, node: Node, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION) -> None:
        """Declare the publisher of ``/topic``, then announce it."""
        self._node, self._topic, self._type_name, self._version = node, topic, type_name, version
        key = names.key(node.domain_id, topic, type_name, names.wire_hash(type_name, version))
        how: dict[str, Any] = {
            "congestion_control": getattr(zenoh.CongestionControl, "BLOCK" if qos.reliable else "DROP"),
            "reliability": getattr(zenoh.Reliability, "RELIABLE" if qos.reliable else "BEST_EFFORT"),
            "express": True,
        }
        with refusals(topic):
            if qos.latched:
                cache = ext.CacheConfig(qos.depth or CACHED_AT_MOST)
                self._publisher: Any = ext.declare_advanced_publisher(
                    node.session, key, cache=cache, publisher_detection=True, **how
                )
            else:
                self._publisher = node.session.declare_publisher(key, **how)
        self._latched = qos.latched
        self._seen = node.announce(names.PUBLISHER, topic, type_name, version, qos)
        self._stamps = Stamps(self._seen.gid)

    def pack(self, message: Any) -> bytearray:
        """Serialise to CDR."""
        return plain_cdr(serialise(message, self._type_name, self._version))

    def send(self, packed: bytearray) -> None:
        """Put, without holding the GIL while a link is busy."""
        with refusals(self._topic):
            self._publisher.put(packed, attachment=self._stamps.next())
        give_way()

    def matched(self) -> int:
        """Count the subscriptions that are announced, once the router has told that there are any."""
        with refusals(self._topic):
            if not (self._latched or self._publisher.matching_status.matching):
                return 0
        return self._node.matching(names.SUBSCRIPTION, self._seen.entity)


class ZenohSubscription:
    """Receives messages of one type from one topic, on the consuming thread."""

    def __init__(
        self,
        node: Node,
        topic: str,
        type_name: str,
        qos: QoS,
        version: str = DEFAULT_VERSION,
        bell: Bell | None = None,
    ) -> None:
        """Declare the subscriber of ``/topic``, then announce it; ``bell`` is rung by what arrives."""
        self._node, self._topic, self._type_name, self._version = node, topic, type_name, version
        self._oldest_ns = round(qos.lifespan_s * 1e9)
        self._said = False
        self._bell = bell or Bell()
        self._inbox: Inbox[Any] = Inbox(topic, self._bell, qos.depth)
        self.interrupt = self._bell.interrupt
        self._subscriber = subscriber(node, topic, type_name, qos, version, self._inbox)
        self._seen = node.announce(names.SUBSCRIPTION, topic, type_name, version, qos)

    def take(self, timeout_s: float) -> memoryview | None:
        """Return the next message's CDR."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        while not self._bell.interrupted:
            sample = self._inbox.take()
            if sample is None:
                if not self._bell.wait_until(deadline_ns):
                    return None
            elif self._wanted(sample):
                return memoryview(sample.payload.to_bytes())
        return None

    def _wanted(self, sample: Any) -> bool:
        """Whether a sample is a message of ROS's, and young enough; what is none is told once."""
        try:
            _, source_ns, _ = names.attached(sample.attachment.to_bytes() if sample.attachment else b"")
        except TransportError as error:
            if not self._said:
                self._said = True
                _log.warning("%s: dropped a message: %s", self._topic, error)
            return False
        return not self._oldest_ns or time.time_ns() - source_ns <= self._oldest_ns

    def arrived(self) -> Any:
        """Take what has arrived, a bounded number."""
        return (memoryview(sample.payload.to_bytes()) for sample in self._inbox.arrived() if self._wanted(sample))

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise; arrays are views of the received bytes."""
        return deserialise(packed, self._type_name, self._version)

    def announced(self) -> bool:
        """Return whether there is a publisher, even one with another version of the type, whom we do not hear."""
        return any(True for _ in self._node.peers(names.PUBLISHER, self._seen.entity))

    def matched(self) -> int:
        """Count the publishers that are announced."""
        return self._node.matching(names.PUBLISHER, self._seen.entity)


def subscriber(node: Node, topic: str, type_name: str, qos: QoS, version: str, inbox: Inbox[Any]) -> Any:
    """Declare what fills an inbox with samples; of a latched topic also with those that its publishers keep."""
    key = names.key(node.domain_id, topic, type_name, names.wire_hash(type_name, version))

    held = ref(inbox)  # Zenoh keeps the callback for as long as the session lives

    def put(sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.PUT and (kept := held()) is not None:
            kept.put(sample, len(sample.payload))

    with refusals(topic):
        if not qos.latched:
            return node.session.declare_subscriber(key, direct(put))
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth or CACHED_AT_MOST)
        return ext.declare_advanced_subscriber(
            node.session, key, direct(put), history=history, subscriber_detection=True
        )
