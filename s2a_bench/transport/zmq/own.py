"""GR00T's words, and the one that our client adds to them.

A request of our client has what `transport.ours` adds beside GR00T's keys. Once it is answered the client asks `MARKS`,
by that request's id, for what the server marked; nothing of it is measured.
"""

from __future__ import annotations

from typing import Final

MARKS: Final = "s2a_marks"
GET_ACTION, PING, RESET, MODALITIES, KILL = "get_action", "ping", "reset", "get_modality_config", "kill"
ENDPOINT, DATA, TOKEN, ERROR, RETRY = "endpoint", "data", "api_token", "error", "retry_after_s"
