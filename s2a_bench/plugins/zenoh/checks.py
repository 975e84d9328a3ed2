"""What the doctor checks for Zenoh."""

from __future__ import annotations

from typing import Final

from s2a_bench.extras import how_to_install
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.plugins.zenoh.router import ROUTER, endpoint_of

STATE_AT: Final = 3
"""The column of /proc/net/tcp that holds a socket's state."""
LISTEN: Final = "0A"


def zenoh(machine: Machine) -> Finding:
    """Return whether Zenoh can be spoken, and whether a router listens where rmw_zenoh's nodes look for one."""
    if not machine.finds("zenoh"):
        return Finding("zenoh", "state", "not installed", how_to_install("zenoh"))
    port = f":{endpoint_of(ROUTER)[2]:04X}"
    lines = [line.split() for name in ("tcp", "tcp6") for line in (machine.read(f"proc/net/{name}") or "").splitlines()]
    there = any(len(line) > STATE_AT and line[1].endswith(port) and line[STATE_AT] == LISTEN for line in lines)
    absent = f"no router listens at {ROUTER}: serve ros --middleware zenoh starts it"
    return Finding("zenoh", "state", f"a router listens at {ROUTER}" if there else absent)
