"""Default transports of commands: the only names of transports outside their folders."""

from __future__ import annotations

from typing import Final

COMPARED: Final = ("http", "ros")
"""Transports of requests."""
FOLLOWED: Final = "ros"
"""The transport of a streamed plan."""
LOOPBACK: Final = "loopback"
"""An engine in this process."""
LLAMA_SERVER: Final = "http/llama-server"
"""llama.cpp's server, which a run starts."""
BESIDE: Final = ("ros", LOOPBACK)
"""Transports that servers of other protocols are compared with."""
