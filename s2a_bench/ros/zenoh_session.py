"""Sessions of Zenoh: with a router that is there, or as the router. On loopback, unless the user names another host.

rmw_zenoh's nodes meet at a router. A server of ours that finds none is one itself: its session listens on loopback, so
nothing but the link is between it and its clients. Scouting by multicast is off, and clients listen on nothing.
"""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from contextlib import closing
from typing import Any, Final

import zenoh

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.ros import ROUTER

ENDPOINT: Final = re.compile(r"(tcp|udp|tls|quic|ws)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+):([0-9]{1,5})")
PLACE: Final = re.compile(r"!?\s+at /\S+")
MESSAGE_BYTES: Final = 128 << 20
"""A larger message is dropped as it comes in."""
OPEN_MS: Final = 5000
"""So long a router may take to say what it is."""
SEND_US: Final = 5_000_000
"""A peer that reads nothing for so long is hung up on."""
LOOK_S: Final = 1.0


def endpoint_of(text: str) -> tuple[str, str, int]:
    """Return protocol, host and port of an endpoint as ``tcp/127.0.0.1:7447``; raises UsageError."""
    found = ENDPOINT.fullmatch(text)
    if not found or not 0 < int(found[3]) < 2**16:
        raise UsageError(f"router: '{text}' should look like {ROUTER}")
    return found[1], found[2].strip("[]"), int(found[3])


def listens(endpoint: str) -> bool:
    """Return whether somebody listens there; of what is not TCP, as if so."""
    protocol, host, port = endpoint_of(endpoint)
    if protocol != "tcp":
        return True
    try:
        socket.create_connection((host, port), LOOK_S).close()
    except OSError:
        return False
    return True


def may_host(endpoint: str) -> bool:
    """Return whether a server of ours may be the router there: on loopback, without being asked who comes."""
    protocol, host, _ = endpoint_of(endpoint)
    try:
        return protocol == "tcp" and (host == "localhost" or ipaddress.ip_address(host).is_loopback)
    except ValueError:
        return False


def free_endpoint() -> str:
    """Return an endpoint on loopback where nobody listens."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def open_session(endpoint: str, *, host: bool) -> zenoh.Session:
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
        "timestamping/enabled": True,  # latched topics are told apart by it
        "transport/link/rx/max_message_size": MESSAGE_BYTES,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": SEND_US,
        "transport/unicast/open_timeout": OPEN_MS,
        "transport/unicast/accept_timeout": OPEN_MS,
    }
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
            "or name it with `router`"
        )
        raise TransportError(f"{what} ({told(error)}): {way}") from error


def told(error: zenoh.ZError) -> str:
    """Return what Zenoh says, less the places in its sources where it says so."""
    return PLACE.sub("", str(error))[:200]
