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
    """Return the transport of a control loop, and the default in words.

    It is the first, by `order`, that has a server of ours and answers with actions alone.
    """
    able = [each for _, each in TRANSPORTS.loaded() if each.serves and each.answer_kinds == (ACTIONS,)]
    if not able:
        return ACTING, ACTING
    first = min(able, key=lambda each: each.order)
    installed = all(map(extras.installed, first.needs[1:]))
    return first.name if installed else ACTING, f"{first.name}, {ACTING} where its packages are not installed"
