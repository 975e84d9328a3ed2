"""The middleware on Zenoh from PyPI, in the keys, attachments and tokens of rmw_zenoh.

Topics are CDR with an attachment; latched ones are cached by their publisher. A service is a complete queryable, which
answers queries under the client's name.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version as package_version
from typing import Any, Final
from weakref import ref

import zenoh
from zenoh import ext

from s2a_bench.errors import TransportError
from s2a_bench.plugins.zenoh import names
from s2a_bench.plugins.zenoh.node import Bell, Node, SampleQueue, direct, give_way, open_session, refusals
from s2a_bench.ros import SERVICE_QOS, Offer, QoS, Tuning
from s2a_bench.ros.action import ActionNode
from s2a_bench.ros.messages import CDR_HEADER, DEFAULT_VERSION, deserialise, serialise
from s2a_bench.ros.service import ClientEnd, LogOnce, ServiceEnd, ServiceSpec, awaited

CACHED_AT_MOST: Final = 1000
"""The depth of a latched topic with KEEP_ALL."""
ANSWER_S: Final = 86_400.0
"""A query may wait so long for its reply, as that for a goal's result does; callers wait less."""

_log = logging.getLogger(__name__)


class ZenohPublisher:
    def __init__(self, node: Node, topic: str, type_name: str, qos: QoS, version: str) -> None:
        self._node, self._topic, self._type_name, self._version = node, topic, type_name, version
        key = node.key(topic, type_name, version)
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
        self.entity = self._seen.entity

    def pack(self, message: Any) -> bytearray:
        return serialise(message, self._type_name, self._version, padded=False)

    def send(self, packed: bytearray) -> None:
        """Put, without holding the GIL while a link is busy."""
        with refusals(self._topic):
            self._publisher.put(packed, attachment=self._seen.attachment())
        give_way()

    def matched(self) -> int:
        """Count the subscriptions that are announced, once the router reports any."""
        with refusals(self._topic):
            if not (self._latched or self._publisher.matching_status.matching):
                return 0
        return self._node.matching(names.SUBSCRIPTION, self._seen.entity)


class ZenohSubscription:
    def __init__(self, node: Node, topic: str, type_name: str, qos: QoS, version: str, bell: Bell) -> None:
        self._node, self.topic, self._type_name, self._version = node, topic, type_name, version
        self._oldest_ns = round(qos.lifespan_s * 1e9)
        self._once = LogOnce(_log)
        self._bell = bell
        self._inbox: SampleQueue[Any] = SampleQueue(topic, self._bell, qos.depth)
        self._sender = b""
        self.interrupt = self._bell.interrupt
        self._subscriber = self._declared(node.key(topic, type_name, version), qos)
        self._seen = node.announce(names.SUBSCRIPTION, topic, type_name, version, qos)

    def _declared(self, key: str, qos: QoS) -> Any:
        """Declare the subscriber that fills the inbox; of a latched topic also with the samples its publishers keep."""
        held = ref(self._inbox)  # Zenoh keeps the callback for as long as the session lives

        def put(sample: Any) -> None:
            if sample.kind == zenoh.SampleKind.PUT and (kept := held()) is not None:
                kept.put(sample, len(sample.payload))

        with refusals(self.topic):
            if not qos.latched:
                return self._node.session.declare_subscriber(key, direct(put))
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth or CACHED_AT_MOST)
            return ext.declare_advanced_subscriber(
                self._node.session, key, direct(put), history=history, subscriber_detection=True
            )

    def take(self, timeout_s: float) -> memoryview | None:
        return awaited(self._next, self._bell, timeout_s)

    def _next(self) -> memoryview | None:
        while not self._bell.interrupted and (sample := self._inbox.take()) is not None:
            if self._wanted(sample):
                return memoryview(sample.payload.to_bytes())
        return None

    def _wanted(self, sample: Any) -> bool:
        """Return True for a ROS message within its lifespan; log the first that is not a ROS message."""
        try:
            _, source_ns, self._sender = names.attached(sample.attachment.to_bytes() if sample.attachment else b"")
        except TransportError as error:
            self._once.warning("", "%s: dropped a message: %s", self.topic, error)
            return False
        return not self._oldest_ns or time.time_ns() - source_ns <= self._oldest_ns

    def sender(self) -> bytes:
        return self._sender

    def sender_hears(self, sender: bytes, publisher: ZenohPublisher) -> bool:
        sessions = self._node.sessions(names.PUBLISHER, self._seen.entity, sender)
        return not sessions or bool(sessions & self._node.sessions(names.SUBSCRIPTION, publisher.entity))

    def arrived(self) -> Any:
        return (memoryview(sample.payload.to_bytes()) for sample in self._inbox.arrived() if self._wanted(sample))

    def unpack(self, packed: memoryview) -> Any:
        return deserialise(packed, self._type_name, self._version)

    def announced(self) -> int:
        return sum(1 for _ in self._node.peers(names.PUBLISHER, self._seen.entity))

    def matched(self) -> int:
        return self._node.matching(names.PUBLISHER, self._seen.entity)


@dataclass(frozen=True, slots=True)
class QueryOrigin:
    """A query, and the part of its attachment that the reply repeats."""

    query: zenoh.Query
    sequence: int
    gid: bytes


class ZenohServiceServer(ServiceEnd[QueryOrigin]):
    body_at = CDR_HEADER

    def __init__(self, node: Node, spec: ServiceSpec, bell: Bell, qos: QoS) -> None:
        """Declare the queryable, then announce it; ``bell`` is rung by what arrives."""
        self.spec, self._node = spec, node
        self._key = node.key(spec.name, spec.type_name, spec.version)
        self._inbox: SampleQueue[zenoh.Query] = SampleQueue(spec.name, bell)
        self._once = LogOnce(_log)
        held = ref(self._inbox)

        def put(query: zenoh.Query) -> None:
            inbox = held()
            if inbox is None or not inbox.put(query, len(query.payload or b"")):
                query.drop()

        with refusals(spec.name):
            # Complete, as rmw_zenoh's clients send requests to complete queryables only.
            self._queryable = node.session.declare_queryable(self._key, direct(put), complete=True)
        self._seen = node.announce(names.SERVICE, spec.name, spec.type_name, spec.version, qos)

    def arrived(self) -> Iterator[tuple[memoryview, QueryOrigin]]:
        """Take the queries that have arrived, a bounded number; drop those not of rmw_zenoh and log the first."""
        for query in self._inbox.arrived():
            payload, attachment = query.payload, query.attachment
            try:
                sequence, _, gid = names.attached(attachment.to_bytes() if attachment else b"")
            except TransportError as error:
                query.drop()
                self._once.warning("", "%s: dropped a request: %s", self.spec.name, error)
            else:
                yield memoryview(payload.to_bytes() if payload else b""), QueryOrigin(query, sequence, gid)

    def drop(self, caller: QueryOrigin) -> None:
        caller.query.drop()

    def pack(self, body: Any) -> bytearray:
        return serialise(body, self.spec.reply_type, self.spec.version, padded=False)

    def unpack(self, packed: memoryview) -> Any:
        return deserialise(packed, self.spec.request_type, self.spec.version)

    def unreached(self) -> Iterator[str]:
        own = self._seen.entity
        return (hashed for hashed in self._node.peers(names.CLIENT, own) if hashed != own.type_hash)

    def respond(self, packed: bytearray, caller: QueryOrigin) -> None:
        attachment = names.attachment(caller.sequence, caller.gid)
        with refusals(self.spec.name):
            try:
                caller.query.reply(self._key, packed, attachment=attachment, express=True)
            finally:
                caller.query.drop()
        give_way()


class ZenohServiceClient(ClientEnd):
    body_at = CDR_HEADER

    def __init__(self, node: Node, spec: ServiceSpec, bell: Bell) -> None:
        self.spec, self._node = spec, node
        self._inbox: SampleQueue[tuple[bytes, Any]] = SampleQueue(spec.name, bell)
        with refusals(spec.name):
            self._querier = node.session.declare_querier(
                node.key(spec.name, spec.type_name, spec.version),
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_S,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )
        self._seen = node.announce(names.CLIENT, spec.name, spec.type_name, spec.version, SERVICE_QOS)

    def pack(self, body: Any) -> bytearray:
        return serialise(body, self.spec.request_type, self.spec.version, padded=False)

    def unpack(self, packed: memoryview) -> Any:
        return deserialise(packed, self.spec.reply_type, self.spec.version)

    def call(self, packed: bytearray, goal_id: bytes) -> None:
        """Send a request that concerns ``goal_id``; the first reply to it counts."""
        held = ref(self._inbox)
        answered: list[bool] = []

        def put(reply: zenoh.Reply) -> None:
            inbox = held()
            if inbox is not None and reply.ok is not None and not answered:
                answered.append(True)
                inbox.put((goal_id, reply.ok.payload), len(reply.ok.payload))

        def end() -> None:
            inbox = held()
            if inbox is not None and not answered:
                inbox.put((goal_id, None), 0)

        with refusals(self.spec.name):
            handler = zenoh.handlers.Callback(put, end, indirect=False)
            self._querier.get(handler, payload=packed, attachment=self._seen.attachment())
        give_way()

    def replies(self) -> Iterator[tuple[bytes, memoryview | None]]:
        for key, payload in self._inbox.arrived():
            yield key, None if payload is None else memoryview(payload.to_bytes())

    def matched(self) -> bool:
        """Return whether a server is there: one of our version that is reached, or only others."""
        hashes = [*self._node.peers(names.SERVICE, self._seen.entity)]
        if self._seen.entity.type_hash in hashes:
            with refusals(self.spec.name):
                return bool(self._querier.matching_status.matching)
        return bool(hashes)

    def peer_type_hash(self) -> str:
        """Return the type hash that a server announces, ours rather than another; empty without one."""
        hashes = {*self._node.peers(names.SERVICE, self._seen.entity)} - {names.NO_HASH}
        own = self._seen.entity.type_hash
        return own if own in hashes else next(iter(hashes), "")


class ZenohMiddleware(ActionNode[QueryOrigin, Bell]):
    def __init__(self, domain_id: int, tuning: Tuning, node_name: str, router: str, host: bool) -> None:
        """Join ``domain_id`` as the node ``/namespace/name``; raises TransportError where no router answers."""
        self._domain_id, self._tuning, self._router, self._host = domain_id, tuning, router, host
        self._session = open_session(router, host=host, tuning=tuning)
        super().__init__()
        try:
            self._node = Node(self._session, domain_id, node_name)
        except BaseException:
            self.close()
            raise

    def waiter(self) -> Bell:
        self.check_open()
        return Bell()

    def publisher(self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION) -> ZenohPublisher:
        self.check_open()
        return ZenohPublisher(self._node, topic, type_name, qos, version)

    def subscription(
        self, topic: str, type_name: str, qos: QoS, version: str = DEFAULT_VERSION, waiter: Bell | None = None
    ) -> ZenohSubscription:
        return ZenohSubscription(self._node, topic, type_name, qos, version, waiter or self.waiter())

    def offers(self) -> list[Offer]:
        return self._node.offers()

    def service_end(self, spec: ServiceSpec, waiter: Bell, qos: QoS | None = None) -> ZenohServiceServer:
        return ZenohServiceServer(self._node, spec, waiter, qos or SERVICE_QOS)

    def client_end(self, spec: ServiceSpec, waiter: Bell) -> ZenohServiceClient:
        return ZenohServiceClient(self._node, spec, waiter)

    def describe(self) -> dict[str, str | int]:
        return {
            "middleware": "zenoh",
            "version": package_version("eclipse-zenoh"),
            "domain_id": self._domain_id,
            "tuning": self._tuning,
            "router": self._router,
            "router_is": "this process" if self._host else "another process",
        }

    def leave(self) -> None:
        self._session.close()
