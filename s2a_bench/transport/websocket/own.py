"""openpi's words, and the one by which our client and server know each other.

Our client says who it is in a header of its handshake. Then its observations have what `transport.ours` adds, and each
answer is followed by one more frame with the server's marks.
"""

from __future__ import annotations

from typing import Final

MARKS_HEADER: Final = "S2A-Marks"
SCHEME: Final = "Api-Key"
"""Of the Authorization header, as openpi's client sends it."""
HEALTH: Final = "/healthz"
ACTIONS, TYPE, TIMING, INDICES = "actions", "type", "server_timing", "action_indices"
PARTIAL, FINAL = "partial", "final"
