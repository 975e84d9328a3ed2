"""The words that our client and server add to GR00T's: between them alone, never sent to anybody else's.

A request of our client has the key `OWN` beside GR00T's with the request's other fields. Once it is answered the client
asks `MARKS`, by that request's id, for what the server marked; nothing of it is measured.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import SEEDS, Limits, text, whole_number
from s2a_bench.transport.observed import observed
from s2a_bench.types import Request

OWN: Final = "s2a"
MARKS: Final = "s2a_marks"
GET_ACTION, PING, RESET, MODALITIES, KILL = "get_action", "ping", "reset", "get_modality_config", "kill"
ENDPOINT, DATA, TOKEN, ERROR, RETRY = "endpoint", "data", "api_token", "error", "retry_after_s"


def parameters(request: Request) -> dict[str, Any]:
    """Return the fields of a request that no observation has."""
    told = {"id": request.id, "max_tokens": request.max_tokens, "seed": request.seed, "grammar": request.grammar}
    return {name: value for name, value in told.items() if value}


def told_in(message: dict[Any, Any]) -> dict[Any, Any] | None:
    """Return what our client added to a message, None for anybody else's."""
    told = message.get(OWN)
    if told is not None and not isinstance(told, dict):
        raise RequestFailed(f"{OWN} should be a map")
    return told


def request_of(observation: Any, told: dict[Any, Any], trace: Trace, limits: Limits) -> Request:
    """Read an observation, decode its pictures; raises RequestFailed."""
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
