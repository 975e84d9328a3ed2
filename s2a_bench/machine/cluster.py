"""A Ray cluster of several machines."""

from __future__ import annotations

import os
import socket
from typing import Any, Final

from s2a_bench import extras
from s2a_bench.errors import UsageError

LOCAL: Final = "local"
PROBE_S: Final = 5.0
OBJECT_STORE_BYTES: Final = 256 << 20
"""The object store of a local cluster: run folders are small."""


def connect(address: str, jobs: int) -> Any:
    """Join the cluster at an address, or make one of ``jobs`` cores for "local", and return Ray; raises S2AError."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage statistics
    ray = extras.require("ray", "ray")
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == LOCAL:
        ray.init(num_cpus=jobs, include_dashboard=False, object_store_memory=OBJECT_STORE_BYTES, address=LOCAL, **quiet)
        return ray
    try:
        host, colon, port = address.rpartition(":")
        if colon and port.isdecimal():  # Ray itself tries for minutes
            socket.create_connection((host.rpartition("/")[2], int(port)), PROBE_S).close()
        ray.init(address=address, **quiet)
    except (OSError, ValueError, RuntimeError) as error:
        raise UsageError(f"`ray`: no Ray cluster answers at {address}: {str(error).splitlines()[0]}") from error
    return ray
