"""The middleware on Zenoh from PyPI, as rmw_zenoh speaks it, and the router at which its nodes meet."""

from __future__ import annotations

import re
import socket
from contextlib import closing
from typing import Final

from s2a_bench.errors import UsageError
from s2a_bench.extras import how_to_install
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.ros import MeetingPlace, MiddlewareKind
from s2a_bench.transport.listening import is_loopback

EXTRA = "ROS 2 over Zenoh, as rmw_zenoh speaks it"
ROUTER: Final = "tcp/127.0.0.1:7447"
"""The address at which rmw_zenoh's nodes look for their router."""
ENDPOINT: Final = re.compile(r"(tcp|udp|tls|quic|ws)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+):([0-9]{1,5})")
LOOK_S: Final = 1.0
STATE_AT: Final = 3
"""The column of /proc/net/tcp that holds a socket's state."""
LISTEN: Final = "0A"


def endpoint_of(text: str) -> tuple[str, str, int]:
    """Return protocol, host and port of an endpoint as ``tcp/127.0.0.1:7447``; raises UsageError."""
    match = ENDPOINT.fullmatch(text)
    if not match or not 0 < int(match[3]) < 2**16:
        raise UsageError(f"router: '{text[:100]}' should look like {ROUTER}")
    return match[1], match[2].strip("[]"), int(match[3])


def listens(endpoint: str) -> bool:
    """Return True if a TCP peer listens there; always True for other protocols."""
    protocol, host, port = endpoint_of(endpoint)
    if protocol != "tcp":
        return True
    try:
        socket.create_connection((host, port), LOOK_S).close()
    except OSError:
        return False
    return True


def to_host(endpoint: str) -> str:
    """Return where a new server of ours is the router: at a free port without ``endpoint``, "" if it is a client.

    Without authentication it is so on loopback only.
    """
    if not endpoint:
        return free_endpoint()
    protocol, host, _ = endpoint_of(endpoint)
    return endpoint if protocol == "tcp" and is_loopback(host) and not listens(endpoint) else ""


def free_endpoint() -> str:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def check(machine: Machine) -> Finding:
    """Return whether Zenoh can be spoken, and whether a router listens where rmw_zenoh's nodes look for one."""
    if not machine.finds("zenoh"):
        return Finding("zenoh", "state", "not installed", how_to_install("zenoh"))
    port = f":{endpoint_of(ROUTER)[2]:04X}"
    lines = [line.split() for name in ("tcp", "tcp6") for line in (machine.read(f"proc/net/{name}") or "").splitlines()]
    there = any(len(line) > STATE_AT and line[1].endswith(port) and line[STATE_AT] == LISTEN for line in lines)
    absent = f"no router listens at {ROUTER}: serve ros --middleware zenoh starts it"
    return Finding("zenoh", "state", f"a router listens at {ROUTER}" if there else absent)


ZENOH = MiddlewareKind(
    "s2a_bench.plugins.zenoh.middleware:ZenohMiddleware",
    "zenoh",
    f"{how_to_install('zenoh')}, or use --middleware cyclonedds",
    "rmw_zenoh_cpp",
    meeting_place=MeetingPlace(
        "router",
        f"Zenoh's router, as {ROUTER}; a server starts it on loopback [default: one of the run's own]",
        "Zenoh router",
        ROUTER,
        check=endpoint_of,
        to_host=to_host,
    ),
    against_loss="--qos reliable: what is best effort is dropped where Zenoh's link is busy",
    extra="zenoh",
    packages=("eclipse-zenoh",),
    checks={"zenoh": "s2a_bench.plugins.zenoh:check"},
)
