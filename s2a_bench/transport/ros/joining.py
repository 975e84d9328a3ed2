"""Joining the domain of a wiring, alone under its namespace where that matters."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import TypeVar

from s2a_bench.clock import now_ns, realtime_offset_ns
from s2a_bench.errors import ServerDied, TransportError
from s2a_bench.ros import Middleware, QoS, Tuning, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.config import domain_id
from s2a_bench.ros.llama import GENERATE_RESPONSE
from s2a_bench.ros.remap import Remapped, table
from s2a_bench.ros.service import appeared
from s2a_bench.transport import Client, Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.ros.camera import CAMERA, COMPRESSED_CAMERA, POLL_S, CameraPublisher
from s2a_bench.transport.ros.options import NAMESPACE, RosOptions

T = TypeVar("T")
AT = "@"
"""The separator in an address between the namespace and the meeting place that the server hosts itself."""
MATCH_TIMEOUT_S = 15.0
SETTLE_S = 0.3
"""Time to discover a server that is there already."""


def namespace_of(wiring: Wiring[RosOptions]) -> str:
    """Return the namespace of our topics; an external action is not under it."""
    address = wiring.address.partition(AT)[0]
    return (not wiring.options.action and address) or wiring.options.namespace or NAMESPACE


def domain_of(wiring: Wiring[RosOptions]) -> int:
    """Return the DDS domain; raises UsageError for an invalid ROS_DOMAIN_ID."""
    return domain_id(os.environ, wiring.options.domain_id)


def meeting_place(wiring: Wiring[RosOptions]) -> str:
    """Return where nodes meet: at the server, else where the option says; "" is the middleware's default."""
    return wiring.address.partition(AT)[2] or wiring.options.kind.place_in(wiring.options)


def place_of(wiring: Wiring[RosOptions]) -> str:
    domain = f"domain {domain_of(wiring)}"
    at = wiring.options.kind.meeting_place
    return f"{domain} of the {at.title} {meeting_place(wiring) or at.default}" if at else f"DDS {domain}"


def settled(wiring: Wiring[RosOptions]) -> tuple[Wiring[RosOptions], bool]:
    """Return a server's wiring, and whether it is to be the meeting place itself, which is then in its address.

    Without an option that names one, each server of a run is its own.
    """
    at = wiring.options.kind.meeting_place
    if not (place := at and at.to_host(meeting_place(wiring))):
        return wiring, False
    return replace(wiring, address=f"{namespace_of(wiring)}{AT}{place}"), True


def server_name(wiring: Wiring[RosOptions]) -> str:
    return f"{namespace_of(wiring)}/{wiring.options.node_name}"


def join(wiring: Wiring[RosOptions], role: str, *, host: bool = False) -> Middleware:
    """Join the domain as the node ``<namespace>/<role>``, the server under its own; ``host``: where all meet."""
    tuning: Tuning = wiring.options.dds_tuning
    name = server_name(wiring) if role == "server" else f"{namespace_of(wiring)}/{role}"
    joined = open_middleware(
        wiring.options.middleware,
        domain_id=domain_of(wiring),
        tuning=tuning,
        node_name=name,
        place=meeting_place(wiring),
        host=host,
    )
    names = remapped(wiring)
    return Remapped(joined, names) if names else joined


def remapped(wiring: Wiring[RosOptions]) -> dict[str, str]:
    """Return absolute name -> what stands for it."""
    rules, camera = wiring.options.remap, wiring.options.camera_topic
    names = table((*rules, f"{CAMERA[1:]}:={camera}") if camera else rules, server_name(wiring))
    raw = namespace_of(wiring) + CAMERA
    if raw in names:  # image_transport keeps what is compressed below it
        below = COMPRESSED_CAMERA.removeprefix(CAMERA)
        names.setdefault(raw + below, names[raw] + below)
    return names


def refuse_company(wiring: Wiring[RosOptions], namespace: str) -> None:
    """Raise TransportError if another server listens under ``namespace``: both would answer every request."""
    probe = join(wiring, "probe")
    try:
        publisher = probe.publisher(namespace + "/request", ros.REQUEST, QoS())
        built = wiring.options.kind.builds(GENERATE_RESPONSE)
        action = probe.action_client(namespace + "/generate_response", GENERATE_RESPONSE) if built else None
        probe.subscription(namespace + "/token", ros.TOKEN, QoS()).take(SETTLE_S)
        if publisher.matched() or (action and action.server_present()):
            raise TransportError(
                f"another server answers under {namespace} in {place_of(wiring)}: stop it, "
                f"choose another domain with ROS_DOMAIN_ID or another `namespace`, or measure that server with `url` ros://{namespace}"
            )
    finally:
        probe.close()


class RosClient(Client):
    """The base of both variants' clients: a node, the server's camera, and waiting for messages."""

    def __init__(self, wiring: Wiring[RosOptions], alive: Callable[[], bool]) -> None:
        """Join the domain and wait for the server; raises ServerDied if it does not appear."""
        self._wiring, self._alive = wiring, alive
        self._offset_ns = realtime_offset_ns()
        self.middleware = join(wiring, "client")
        try:
            self._meet_server(namespace_of(wiring))
        except TransportError:
            self.close()
            raise

    def _meet_server(self, namespace: str) -> None:
        """Make the client's endpoints and wait until the server has matched them; raises TransportError."""
        raise NotImplementedError

    @cached_property
    def camera(self) -> CameraPublisher | None:
        """The server's camera, from the first use on; none of a server that is not ours. Raises ServerDied.

        The server has subscribed to it: what is sent earlier is lost. Made for a stream only: a server fails what comes
        without a picture where its camera is silent.
        """
        options, namespace = self._wiring.options, namespace_of(self._wiring)
        if options.action:
            return None
        camera = CameraPublisher(self.middleware, namespace, options.payload, options.qos)
        self.wait_until(lambda: bool(camera.matched()), f"no server subscribed to {namespace}{CAMERA}")
        return camera

    def wait_until(self, arrived: Callable[[], bool], absent: str) -> None:
        """Wait for the server to be matched; raises ServerDied, saying what is ``absent``."""
        if not appeared(arrived, MATCH_TIMEOUT_S, lambda: not self._alive()):
            raise ServerDied(
                f"{absent} in {place_of(self._wiring)}; is ROS_DOMAIN_ID the same on both sides, and between hosts "
                "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET?"
            )

    def taken(self, take: Callable[[float], T | None], bounds: Bounds) -> Iterator[T | None]:
        """Yield messages as they come, None if none came for a moment, until the longest silence is over."""
        deadline_ns = now_ns() + int(self._wiring.timeout_s * 1e9)
        while now_ns() < deadline_ns:
            yield take(min(POLL_S, bounds.left_s()))

    def close(self) -> None:
        self.middleware.close()
