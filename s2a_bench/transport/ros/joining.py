"""Joining the DDS domain of a route, alone under its namespace where that matters."""

from __future__ import annotations

from collections.abc import Callable

from s2a_bench.clock import SystemClock
from s2a_bench.errors import ServerDied, TransportError
from s2a_bench.ros import Middleware, QoS, Tuning, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import GENERATE_RESPONSE
from s2a_bench.transport import Route

DEFAULT_NAMESPACE = "/s2a_bench"
MATCH_TIMEOUT_S = 15.0
MATCH_POLL_NS = 10_000_000
SETTLE_S = 0.3
"""Time to discover a server that is there already."""


def join(route: Route, role: str) -> Middleware:
    """Join the route's domain as the node ``<namespace>/<role>``."""
    tuning: Tuning = "default" if route.dds_tuning == "default" else "tuned"
    name = f"{route.address or DEFAULT_NAMESPACE}/{role}"
    return open_middleware(route.middleware, domain_id=route.domain_id, tuning=tuning, node_name=name)


def wait_until(arrived: Callable[[], bool], alive: Callable[[], bool], what: str) -> None:
    """Wait for a peer to be matched; raises ServerDied, saying ``what`` did not appear."""
    clock = SystemClock()
    deadline = clock.now_ns() + int(MATCH_TIMEOUT_S * 1e9)
    while not arrived():
        if clock.now_ns() > deadline or not alive():
            raise ServerDied(f"{what}; is ROS_DOMAIN_ID the same on both sides?")
        clock.sleep_until_ns(clock.now_ns() + MATCH_POLL_NS)


def refuse_company(route: Route, namespace: str) -> None:
    """Raise TransportError if another server listens under ``namespace``: both would answer every request."""
    probe = join(route, "probe")
    try:
        publisher = probe.publisher(namespace + "/request", ros.REQUEST, QoS())
        action = probe.action_client(namespace + "/generate_response", GENERATE_RESPONSE)
        probe.subscription(namespace + "/token", ros.TOKEN, QoS()).take(SETTLE_S)
        if publisher.matched() or action.server_present():
            raise TransportError(
                f"another server answers under {namespace} in DDS domain {route.domain_id}: stop it, "
                "or choose another domain with ROS_DOMAIN_ID or another --namespace"
            )
    finally:
        probe.close()
