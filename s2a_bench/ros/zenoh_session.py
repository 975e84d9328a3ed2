"""Sessions of Zenoh: with a router that is there, or as the router. On loopback, unless the user names another host.

rmw_zenoh's nodes meet at a router. A server of ours that finds none is one itself: its session listens on loopback, so
nothing but the link is between it and its clients. Scouting by multicast is off, and clients listen on nothing.
"""

from __future__ import annotations

import json
import re
from typing import Any, Final

import zenoh

from s2a_bench.errors import TransportError
from s2a_bench.ros import Tuning
from s2a_bench.ros.router import endpoint_of

PLACE: Final = re.compile(r"!?\s+at /\S+")
MESSAGE_BYTES: Final = 128 << 20
"""A larger message is dropped as it comes in."""
RECEIVE_BYTES: Final = 1 << 20
"""Read at once, where Zenoh reads 64 KiB: 640x480 raw arrives in .24 ms instead of .36 (medians, two cores)."""
BATCHES: Final = 16
"""Of 64 KiB wait to be sent, where Zenoh has room for 2: whoever sends a picture of 640x480 goes on at once."""
OPEN_MS: Final = 5000
"""So long a router may take to say what it is."""
SEND_US: Final = 5_000_000
"""A peer that reads nothing for so long is hung up on."""


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
        "timestamping/enabled": True,  # latched topics are told apart by it
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
            "or name it with `router`"
        )
        raise TransportError(f"{what} ({told(error)}): {way}") from error


def told(error: zenoh.ZError) -> str:
    """Return what Zenoh says, less the places in its sources where it says so."""
    return PLACE.sub("", str(error))[:200]
