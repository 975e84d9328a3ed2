"""What our clients and servers add to a policy server's protocol: between them alone, never sent to anybody else's.

A request has the key `OWN` with its fields that no observation has, and so has the message with the server's marks. How
the two know each other, and when the marks travel, is each protocol's own.
"""

from __future__ import annotations

from typing import Any, Final

from s2a_bench.errors import RequestFailed
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import SEEDS, Limits, text, whole_number
from s2a_bench.transport.observed import observed
from s2a_bench.types import Request

OWN: Final = "s2a"


def parameters(request: Request) -> dict[str, Any]:
    """Return the fields of a request that no observation has."""
    told = {"id": request.id, "max_tokens": request.max_tokens, "seed": request.seed, "grammar": request.grammar}
    return {name: value for name, value in told.items() if value}


def told_in(message: Any) -> dict[Any, Any] | None:
    """Take what our client added out of a message, None from anybody else's."""
    told = message.pop(OWN, None) if isinstance(message, dict) else None
    if told is not None and not isinstance(told, dict):
        raise RequestFailed(f"{OWN} should be a map")
    return told


def request_of(observation: Any, told: dict[Any, Any] | None, trace: Trace, limits: Limits) -> Request:
    """Read an observation and what our client added, decode its pictures; raises RequestFailed."""
    told = told or {}
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
    return {OWN: remote.to_json()}


def remote_of(message: Any) -> Remote:
    """Read a server's marks; raises RequestFailed for what can be none."""
    try:
        return Remote.of_json(message[OWN])
    except (LookupError, TypeError, ValueError) as error:
        raise RequestFailed(f"what should be the server's marks is none: {error!r}") from error
