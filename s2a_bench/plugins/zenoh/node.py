"""Our node among those of rmw_zenoh: its session, the liveliness tokens of all nodes, and inboxes of what has arrived.

rmw_zenoh's nodes meet at a router. A server of ours that finds none is one itself: its session listens on loopback, so
nothing but the link is between it and its clients. Scouting by multicast is off, and clients listen on nothing.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count, islice
from threading import Condition, Lock
from typing import Any, Final, Generic, TypeVar

import zenoh

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.plugins.zenoh import endpoint_of, names
from s2a_bench.ros import Offer, QoS, Tuning
from s2a_bench.ros.messages import dds_type_name, ros_type_name
from s2a_bench.ros.remap import check_node_name
from s2a_bench.ros.service import AT_ONCE, WAIT_SLICE_NS, LogOnce

PLACE: Final = re.compile(r"!?\s+at /\S+")
MESSAGE_BYTES: Final = 128 << 20
"""A larger message is dropped as it comes in."""
RECEIVE_BYTES: Final = 1 << 20
"""Read at once, where Zenoh reads 64 KiB: 640x480 raw arrives in 0.24 ms instead of 0.36 (medians, two cores)."""
BATCHES: Final = 16
"""Batches of 64 KiB in the send queue, by default 2: with 16, sending a picture of 640x480 does not block."""
OPEN_MS: Final = 5000
"""The longest time that a router may take to say what it is."""
SEND_US: Final = 5_000_000
"""A peer that reads nothing for so long is hung up on."""
HELD_BYTES: Final = 256 << 20
"""The most bytes that wait in one inbox; later ones are dropped."""
EACH_BYTES: Final = 1024
"""The cost of an item beside its bytes."""

Item = TypeVar("Item")
_log = logging.getLogger(__name__)


def open_session(endpoint: str, *, host: bool, tuning: Tuning = "tuned") -> zenoh.Session:
    """Connect to the router at ``endpoint``, or be it; raises TransportError."""
    endpoint_of(endpoint)
    settings: dict[str, Any] = {
        "mode": "router" if host else "client",
        "listen/endpoints": [endpoint] if host else [],
        "connect/endpoints": [] if host else [endpoint],
        "connect/timeout_ms": 0,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,  # half a second, in which a router looks for others
        "timestamping/enabled": True,  # distinguishes latched samples
        "transport/shared_memory/enabled": False,  # as rmw_zenoh: a process that is killed leaves 16 MiB behind
        "transport/link/rx/max_message_size": MESSAGE_BYTES,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": SEND_US,
        "transport/unicast/open_timeout": OPEN_MS,
        "transport/unicast/accept_timeout": OPEN_MS,
    }
    if tuning == "tuned":
        settings["transport/link/rx/buffer_size"] = RECEIVE_BYTES
        settings["transport/link/tx/queue/size/data"] = BATCHES
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        what = f"cannot be the Zenoh router at {endpoint}" if host else f"no Zenoh router answers at {endpoint}"
        way = (
            "choose another port with `router`"
            if host
            else "start one (ros2 run rmw_zenoh_cpp rmw_zenohd, or s2a-bench serve ros --middleware zenoh), "
            "or name it with `router`, of a source, robot or ego with ?router="
        )
        raise TransportError(f"{what} ({reason_of(error)}): {way}") from error


def reason_of(error: zenoh.ZError) -> str:
    """Return Zenoh's message without the places in its sources."""
    return PLACE.sub("", str(error))[:200]


@dataclass(frozen=True, slots=True)
class AnnouncedEndpoint:
    """An endpoint of ours as others see it; withdrawn when this object is deleted."""

    entity: names.Entity
    gid: bytes
    token: zenoh.LivelinessToken
    _numbers: Iterator[int] = field(default_factory=lambda: count(1))

    def attachment(self) -> bytes:
        return names.attachment(next(self._numbers), self.gid)


class Node:
    """One node of one session; callable from any thread."""

    def __init__(self, session: zenoh.Session, domain_id: int, name: str) -> None:
        """Announce the node ``/namespace/name`` and listen for all others; raises UsageError for an invalid name."""
        check_node_name(name)
        self.session, self.domain_id, self._name = session, domain_id, name
        self._id = str(session.zid())
        self._numbers = count(1)
        self._entities: dict[tuple[str, str], dict[str, names.Entity]] = {}
        """(kind, name) -> token -> what it tells."""
        self._lock = Lock()
        with refusals("node"):
            self._liveliness = session.liveliness()
            self._token = self._liveliness.declare_token(names.node_token(domain_id, self._id, name))
            self._watch = self._liveliness.declare_subscriber(
                f"{names.ADMIN}/{domain_id}/**", direct(self._heard), history=True
            )

    def key(self, name: str, type_name: str, version: str) -> str:
        """Return the key under which messages of a topic or service ``/name`` travel."""
        return names.key(self.domain_id, name, type_name, names.wire_hash(type_name, version))

    def announce(self, kind: str, name: str, type_name: str, version: str, qos: QoS) -> AnnouncedEndpoint:
        hashed = names.wire_hash(type_name, version)
        entity = names.Entity(kind, name.replace("/", "%"), dds_type_name(type_name), hashed)
        token = names.endpoint_token(self.domain_id, self._id, next(self._numbers), self._name, entity, qos)
        with refusals(name):
            return AnnouncedEndpoint(entity, names.gid_of(token), self._liveliness.declare_token(token))

    def peers(self, kind: str, entity: names.Entity) -> Iterator[str]:
        """Yield the type hashes of the endpoints of a kind that have the name and type of ``entity``."""
        with self._lock:
            entities = [*self._entities.get((kind, entity.name), {}).values()]
        return (each.type_hash for each in entities if each.type_name == entity.type_name)

    def sessions(self, kind: str, entity: names.Entity, gid: bytes = b"") -> set[str]:
        """Return the sessions of the endpoints of a kind that match ``entity``, or of the one with a ``gid``."""
        with self._lock:
            entities = [*self._entities.get((kind, entity.name), {}).items()]
        matching = (token for token, each in entities if each.type_hash == entity.type_hash)
        return {names.session_of(token) for token in matching if not gid or names.gid_of(token) == gid}

    def offers(self) -> list[Offer]:
        def offer(token: str, each: names.Entity) -> Offer:
            reliable = not token.rpartition("/")[2].startswith(names.BEST_EFFORT)
            return Offer(each.name.replace("%", "/"), ros_type_name(each.type_name), reliable)

        with self._lock:
            publishers = [of_name for (kind, _), of_name in self._entities.items() if kind == names.PUBLISHER]
            return [offer(*item) for of_name in publishers for item in of_name.items()]

    def matching(self, kind: str, entity: names.Entity) -> int:
        """Count the endpoints of a kind to which ``entity`` speaks, or which speak to it."""
        return sum(hashed == entity.type_hash for hashed in self.peers(kind, entity))

    def _heard(self, sample: Any) -> None:
        """Note an endpoint that appears or leaves; called on a thread of Zenoh."""
        token = str(sample.key_expr)
        entity = names.entity_of(token)
        if entity is None:
            return
        at = (entity.kind, entity.name)
        with self._lock:
            of_name = self._entities.setdefault(at, {})
            if sample.kind == zenoh.SampleKind.PUT:
                of_name[token] = entity
            else:
                of_name.pop(token, None)
            if not of_name:
                del self._entities[at]


@contextmanager
def refusals(what: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"Zenoh: {what}: {reason_of(error)}") from error


def direct(callback: Any) -> Any:
    """Return a handler that is called on the very thread that receives, with no thread of Python's between."""
    return zenoh.handlers.Callback(callback, indirect=False)


def give_way() -> None:
    """Let Zenoh's thread send what was just handed to it, where it waits for this very core.

    Linux wakes it beside its waker. Without this the first of 32 tokens left after the last: 0.75 ms instead of 0.25.
    """
    os.sched_yield()


class Bell:
    """Wakes the thread that empties some inboxes."""

    def __init__(self) -> None:
        self.condition = Condition()
        self.interrupted = False
        self._rung = False

    def ring(self) -> None:
        """Wake the waiting thread; call it with the condition held."""
        self._rung = True
        self.condition.notify()

    def wait_until(self, deadline_ns: int) -> bool:
        with self.condition:
            left_ns = deadline_ns - now_ns()
            if left_ns <= 0 or self.interrupted:
                return False
            if not self._rung:
                self.condition.wait(min(left_ns, WAIT_SLICE_NS) / 1e9)
            self._rung = False
            return not self.interrupted

    def interrupt(self) -> None:
        with self.condition:
            self.interrupted = True
            self.condition.notify_all()


class SampleQueue(Generic[Item]):
    """The inbox of one endpoint: the last ``depth`` items, all for 0."""

    def __init__(self, name: str, bell: Bell, depth: int = 0) -> None:
        self._name, self._bell, self._depth = name, bell, depth
        self._items: deque[tuple[Item, int]] = deque()
        self._bytes, self._once = 0, LogOnce(_log)

    def put(self, item: Item, size: int) -> bool:
        """Add an item and wake the waiting thread; False if the queue is full."""
        size += EACH_BYTES
        with self._bell.condition:
            if self._depth and len(self._items) >= self._depth:
                self._pop()
            full = self._bytes + size > HELD_BYTES
            if not full:
                self._items.append((item, size))
                self._bytes += size
            self._bell.ring()
        if full:
            self._once.warning("", "%s: messages are dropped: %d MiB wait to be taken", self._name, HELD_BYTES >> 20)
        return not full

    def take(self) -> Item | None:
        """Return the oldest item, without waiting."""
        with self._bell.condition:
            return self._pop() if self._items else None

    def arrived(self) -> Iterator[Item]:
        return islice(iter(self.take, None), AT_ONCE)

    def _pop(self) -> Item:
        item, size = self._items.popleft()
        self._bytes -= size
        return item
