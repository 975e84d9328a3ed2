"""Services over Zenoh as rmw_zenoh has them: a query to a complete queryable, which answers under the asker's name."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Lock, Thread
from typing import Any, Final
from weakref import ref

import zenoh

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.ros import REQUEST_BYTES, SERVICE_QOS, QoS
from s2a_bench.ros import zenoh_names as names
from s2a_bench.ros.messages import CDR_HEADER, DEFAULT_VERSION, deserialise, serialise
from s2a_bench.ros.service import Calling, Offered
from s2a_bench.ros.waiting import WAIT_SLICE_NS
from s2a_bench.ros.zenoh_inbox import Bell, Inbox
from s2a_bench.ros.zenoh_node import Node, direct, give_way, refusals
from s2a_bench.ros.zenoh_topic import Stamps, plain_cdr

BODY_AT: Final = CDR_HEADER
SMALL_BYTES: Final = 16 * REQUEST_BYTES
"""So much of a service's requests may wait, where they hold no pictures."""
ANSWER_S: Final = 86_400.0
"""A query may wait so long for its reply, as that for a goal's result does; whoever calls waits less."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Asked:
    """Who asked: a query, and what of its attachment goes back with the reply."""

    query: zenoh.Query
    sequence: int
    gid: bytes


class ServiceServer:
    """The server's side of one service."""

    def __init__(
        self,
        node: Node,
        name: str,
        type_name: str,
        version: str,
        bell: Bell,
        qos: QoS = SERVICE_QOS,
        most_bytes: int = SMALL_BYTES,
    ) -> None:
        """Declare the queryable of ``/name``, then announce it; ``bell`` is rung by what arrives.

        Requests of ``most_bytes`` together may wait, with 0 as many as an inbox holds.
        """
        self.type_name = type_name
        self.request_type, self.reply_type = type_name + "_Request", type_name + "_Response"
        self._name, self._version = name, version
        self._key = names.key(node.domain_id, name, type_name, names.wire_hash(type_name, version))
        self._inbox: Inbox[zenoh.Query] = Inbox(name, bell, most_bytes=most_bytes)
        self._said = False
        held = ref(self._inbox)

        def put(query: zenoh.Query) -> None:
            inbox = held()
            if inbox is None or not inbox.put(query, len(query.payload or b"")):
                query.drop()

        with refusals(name):
            self._queryable = node.session.declare_queryable(self._key, direct(put), complete=True)
        self.seen = node.announce(names.SERVICE, name, type_name, version, qos)

    def arrived(self) -> Iterator[tuple[memoryview, Asked]]:
        """Take what has arrived, a bounded number: (CDR, who asked)."""
        for query in self._inbox.arrived():
            if (asked := self._asked(query)) is not None:
                yield asked

    def take(self) -> tuple[memoryview, Asked] | None:
        """Return the next request, without waiting."""
        return next(self.arrived(), None)

    def _asked(self, query: zenoh.Query) -> tuple[memoryview, Asked] | None:
        """Read who asked; a query that rmw_zenoh would not make is dropped, and told once."""
        payload, attachment = query.payload, query.attachment
        try:
            sequence, _, gid = names.attached(attachment.to_bytes() if attachment else b"")
        except TransportError as error:
            query.drop()
            if not self._said:
                self._said = True
                _log.warning("%s: dropped a request: %s", self._name, error)
            return None
        return memoryview(payload.to_bytes() if payload else b""), Asked(query, sequence, gid)

    def pack(self, body: Any) -> bytearray:
        """Serialise a reply."""
        return plain_cdr(serialise(body, self.reply_type, self._version))

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise a request; raises TransportError."""
        return deserialise(packed, self.request_type, self._version)

    def reaches(self, caller: Asked) -> bool:  # noqa: ARG002 - a query knows its way back
        """Return True: who has left is not waited for."""
        return True

    def respond(self, packed: bytearray, caller: Asked) -> None:
        """Reply, and end the query."""
        stamp = names.ATTACHMENT.pack(caller.sequence, time.time_ns(), len(caller.gid), caller.gid)
        with refusals(self._name):
            try:
                caller.query.reply(self._key, packed, attachment=stamp, express=True)
            finally:
                caller.query.drop()
        give_way()


class ServiceClient:
    """The client's side of one service."""

    def __init__(self, node: Node, name: str, type_name: str, version: str, bell: Bell) -> None:
        """Declare the querier of ``/name``, then announce it; ``bell`` is rung by what arrives."""
        self.request_type, self.reply_type = type_name + "_Request", type_name + "_Response"
        self.hashed_type = type_name
        self._node, self._name, self._version = node, name, version
        key = names.key(node.domain_id, name, type_name, names.wire_hash(type_name, version))
        self._inbox: Inbox[tuple[bytes, Any]] = Inbox(name, bell)
        with refusals(name):
            self._querier = node.session.declare_querier(
                key,
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_S,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )
        self._seen = node.announce(names.CLIENT, name, type_name, version, SERVICE_QOS)
        self._stamps = Stamps(self._seen.gid)

    def pack(self, body: Any) -> bytearray:
        """Serialise a request."""
        return plain_cdr(serialise(body, self.request_type, self._version))

    def unpack(self, packed: memoryview) -> Any:
        """Deserialise a reply; raises TransportError."""
        return deserialise(packed, self.reply_type, self._version)

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

        with refusals(self._name):
            handler = zenoh.handlers.Callback(put, end, indirect=False)
            self._querier.get(handler, payload=packed, attachment=self._stamps.next())
        give_way()

    def ended(self) -> Iterator[tuple[bytes, memoryview | None]]:
        """Take what has arrived, a bounded number: (goal id, CDR), without CDR where nobody replied."""
        for goal_id, payload in self._inbox.arrived():
            yield goal_id, None if payload is None else memoryview(payload.to_bytes())

    def replies(self) -> Iterator[tuple[bytes, memoryview]]:
        """Yield the replies of those."""
        for goal_id, packed in self.ended():
            if packed is not None and len(packed) > BODY_AT:
                yield goal_id, packed

    def matched(self) -> bool:
        """Return whether a server is there: one of our version that is reached, or only others."""
        hashes = [*self._node.peers(names.SERVICE, self._seen.entity)]
        if self._seen.entity.type_hash in hashes:
            with refusals(self._name):
                return bool(self._querier.matching_status.matching)
        return bool(hashes)

    def peer_type_hash(self) -> str:
        """Return the type hash that a server announces, ours rather than another; empty without one."""
        hashes = {*self._node.peers(names.SERVICE, self._seen.entity)} - {names.NO_HASH}
        own = self._seen.entity.type_hash
        return own if own in hashes else next(iter(hashes), "")


class ZenohServices:
    """The services of one node, answered by one thread."""

    def __init__(self, node: Node) -> None:
        """Start the thread that answers."""
        self._node, self._bell = node, Bell()
        self._offered: list[tuple[ServiceServer, Offered[Asked]]] = []
        self._lock = Lock()
        self._thread = Thread(target=self._serve, name="services", daemon=True)
        self._thread.start()

    def offer(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS) -> None:
        """Create the service ``/name`` and answer it from now on."""
        server = ServiceServer(self._node, name, type_name, DEFAULT_VERSION, self._bell, qos)
        with self._lock:
            self._offered = [*self._offered, (server, Offered(name, server, answer, BODY_AT))]

    def close(self) -> None:
        """End the thread; endpoints go with the session."""
        self._bell.interrupt()
        self._thread.join()

    def _serve(self) -> None:
        while not self._bell.interrupted:
            for server, offered in self._offered:
                for packed, asked in server.arrived():
                    offered.handle(packed, asked)
                    asked.query.drop()  # of a request that was not answered
            self._bell.wait_until(now_ns() + WAIT_SLICE_NS)


class ZenohServiceClient(Calling):
    """Calls one service with queries."""

    def __init__(self, node: Node, name: str, type_name: str) -> None:
        """Create the client's side of the service ``/name``."""
        client = ServiceClient(node, name, type_name, DEFAULT_VERSION, bell := Bell())
        super().__init__(name, client, client.ended, bell)
