"""The words that our client and server add to openpi's: between them alone, never sent to anybody else's.

Our client says so in a header of its handshake. Then its observations have the key `OWN` with the request's other
fields, and each answer is followed by one more frame, ``{OWN: the server's marks}``.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import SEEDS, Limits, text, whole_number
from s2a_bench.transport.observed import observed
from s2a_bench.types import Request

MARKS_HEADER: Final = "S2A-Marks"
SCHEME: Final = "Api-Key"
"""Of the Authorization header, as openpi's client sends it."""
OWN: Final = "s2a"
HEALTH: Final = "/healthz"
ACTIONS, TYPE, TIMING, INDICES = "actions", "type", "server_timing", "action_indices"
PARTIAL, FINAL = "partial", "final"


def parameters(request: Request) -> dict[str, Any]:
    """Return the fields of a request that no observation has."""
    told = {"id": request.id, "max_tokens": request.max_tokens, "seed": request.seed, "grammar": request.grammar}
    return {name: value for name, value in told.items() if value}


def request_of(observation: Any, trace: Trace, limits: Limits, *, ours: bool) -> Request:
    """Read an observation, decode its pictures; raises RequestFailed."""
    told = observation.pop(OWN, {}) if ours and isinstance(observation, dict) else {}
    if not isinstance(told, dict):
        raise RequestFailed(f"{OWN} should be a dictionary")
    images, state, prompt = observed(observation, trace, limits)
    return Request(
        id=text("id", told.get("id")) or "observation-0",
        prompt=prompt,
        images=images,
        max_tokens=whole_number("max_tokens", told.get("max_tokens"), 1, limits.answer_tokens, limits.answer_tokens),
        grammar=text("grammar", told.get("grammar")),
        seed=whole_number("seed", told.get("seed"), 0, SEEDS, 0),
        state=state,
    )


def remote_message(remote: Remote) -> dict[str, Any]:
    """Return what carries a server's marks."""
    return {OWN: asdict(remote)}


def remote_of(message: Any) -> Remote:
    """Read a server's marks; raises RequestFailed for what can be none."""
    try:
        told = message[OWN]
        return Remote(
            clock=told["clock"],
            marks=[(stage, stamp) for stage, stamp in told["marks"]],
            token_ns=told["token_ns"],
            facts=told["facts"],
            provenance=told["provenance"],
        ).check()
    except (KeyError, TypeError, ValueError) as error:
        raise RequestFailed(f"what should be the server's marks is none: {error!r}") from error
