"""Our node among those of rmw_zenoh: the tokens by which it and its endpoints are seen, and those of all others."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from threading import Lock
from typing import Any, Final

import zenoh

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.ros import QoS
from s2a_bench.ros import zenoh_names as names
from s2a_bench.ros.messages import dds_type_name
from s2a_bench.ros.zenoh_session import told

NODE_NAME: Final = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
SEEN_AT_MOST: Final = 65_536
"""So many endpoints of others are counted."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Seen:
    """An endpoint of ours as others see it; it is gone when this is no longer used."""

    entity: names.Entity
    key: str
    """Under which its messages travel."""
    gid: bytes
    token: zenoh.LivelinessToken


class Node:
    """One node of one session; callable from any thread."""

    def __init__(self, session: zenoh.Session, domain_id: int, name: str) -> None:
        """Announce the node ``/namespace/name`` and listen for all others; raises UsageError for what is no name."""
        if not NODE_NAME.fullmatch(name):
            raise UsageError(f"node name '{name}': write it as /name or /namespace/name, letters, digits and _")
        self.session, self.domain_id, self._name = session, domain_id, name
        self._id = str(session.zid())
        self._numbers = count(1)
        self._known: dict[tuple[str, str], dict[str, names.Entity]] = {}
        """(kind, name) -> token -> what it tells."""
        self._count, self._full = 0, False
        self._lock = Lock()
        with refusals("node"):
            self._liveliness = session.liveliness()
            self._token = self._liveliness.declare_token(names.node_token(domain_id, self._id, name))
            self._watch = self._liveliness.declare_subscriber(
                f"{names.ADMIN}/{domain_id}/**", direct(self._heard), history=True
            )

    def entity(self, kind: str, name: str, type_name: str, version: str) -> names.Entity:
        """Return what the token of an endpoint ``/name`` of ROS type ``pkg/kind/Name`` tells."""
        hashed = names.wire_hash(type_name, version)
        return names.Entity(kind, names.mangled(name), dds_type_name(type_name), hashed)

    def announce(self, kind: str, name: str, type_name: str, version: str, qos: QoS) -> Seen:
        """Let others see an endpoint, which is ready."""
        entity = self.entity(kind, name, type_name, version)
        token = names.endpoint_token(self.domain_id, self._id, next(self._numbers), self._name, entity, qos)
        key = names.key(self.domain_id, name, type_name, entity.type_hash)
        with refusals(name):
            return Seen(entity, key, names.gid_of(token), self._liveliness.declare_token(token))

    def peers(self, kind: str, entity: names.Entity) -> Iterator[str]:
        """Yield the type hashes of the endpoints of a kind that have the name and type of ``entity``."""
        with self._lock:
            known = [*self._known.get((kind, entity.name), {}).values()]
        return (each.type_hash for each in known if each.type_name == entity.type_name)

    def matching(self, kind: str, entity: names.Entity) -> int:
        """Count the endpoints of a kind to which ``entity`` speaks, or which speak to it."""
        return sum(hashed == entity.type_hash for hashed in self.peers(kind, entity))

    def _heard(self, sample: Any) -> None:
        """Note an endpoint that has come or gone; on a thread of Zenoh's."""
        token = str(sample.key_expr)
        entity = names.entity_of(token)
        if entity is None:
            return
        at = (entity.kind, entity.name)
        with self._lock:
            of_name = self._known.setdefault(at, {})
            before = len(of_name)
            if sample.kind != zenoh.SampleKind.PUT:
                of_name.pop(token, None)
            elif self._count < SEEN_AT_MOST:
                of_name[token] = entity
            elif not self._full:
                self._full = True
                _log.warning("more than %d endpoints are announced: the rest are not counted", SEEN_AT_MOST)
            self._count += len(of_name) - before
            if not of_name:
                del self._known[at]


class refusals:  # noqa: N801 - as contextlib's
    """Turn what Zenoh refuses into TransportError."""

    __slots__ = ("_what",)

    def __init__(self, what: str) -> None:
        self._what = what

    def __enter__(self) -> None:
        """Begin."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Translate."""
        if isinstance(error, zenoh.ZError):
            raise TransportError(f"Zenoh: {self._what}: {told(error)}") from error


def direct(callback: Any) -> Any:
    """Return a handler that is called on the very thread that receives, with no thread of Python's between."""
    return zenoh.handlers.Callback(callback, indirect=False)


def give_way() -> None:
    """Let Zenoh's thread send what was just handed to it, where it waits for this very core.

    Linux wakes it beside its waker. Without this the first of 32 tokens left after the last: .75 ms instead of .25.
    """
    os.sched_yield()
