"""Default transports of commands: the only names of transports outside their folders."""

from __future__ import annotations

from typing import Final

from s2a_bench import extras
from s2a_bench.transport import ACTIONS, TRANSPORTS

COMPARED: Final = ("http", "ros")
"""Transports of requests."""
FOLLOWED: Final = "ros"
"""The transport of a streamed plan."""
BLACK_BOX: Final = "http"
"""The transport of an external server."""
ACTING: Final = "http/binary"
"""The transport of a control loop, where no transport of actions alone is installed with its packages."""
LOOPBACK: Final = "loopback"
"""An engine in this process."""
LLAMA_SERVER: Final = "http/llama-server"
"""llama.cpp's server, which a run starts."""
BESIDE: Final = ("ros", LOOPBACK)
"""Transports that servers of other protocols are compared with."""


def acting_over() -> tuple[str, str]:
    """Return the transport of a control loop, and in words: the first that serves actions alone, in their order."""
    for name, each in TRANSPORTS.loaded():
        if each.serves and each.answer_kinds == (ACTIONS,):
            installed = all(map(extras.installed, each.needs[1:]))
            return name if installed else ACTING, f"{name}, {ACTING} where its packages are not installed"
    return ACTING, ACTING
