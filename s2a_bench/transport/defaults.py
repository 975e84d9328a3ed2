"""The transports that commands take unless told: what names one outside its folder stands here."""

from __future__ import annotations

from typing import Final

COMPARED: Final = ("http", "ros")
"""What requests are compared over."""
FOLLOWED: Final = "ros"
"""Over which a streamed plan is followed."""
BLACK_BOX: Final = "http"
"""What a server of somebody else's speaks."""
ACTING: Final = ("websocket", "http/binary")
"""Over which a control loop asks for actions, and where the packages of that are not installed."""
LOOPBACK: Final = "loopback"
"""An engine in this process."""
LLAMA_SERVER: Final = "http/llama-server"
"""llama.cpp's own server, which a run starts."""
