"""The payloads beside pictures: requests, tokens and marks as messages of s2a_msgs, and their quality of service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from s2a_bench.errors import RequestFailed, TransportError
from s2a_bench.provenance import Provenance
from s2a_bench.ros import QoS, Subscription
from s2a_bench.ros import messages as ros
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.ros import UNREADABLE_N
from s2a_bench.types import Action, Piece, Request, Token
from s2a_bench.vectors import actions_of

REQUEST_QOS = QoS(depth=10)
TOKEN_QOS = QoS(depth=1000)
"""Our writers keep the last: one that keeps all blocks for as long as a reader does not read."""
PROVENANCE_TOPIC: Final = "/provenance"
"""Below the namespace: the server's provenance, latched for late subscribers."""


def readable(subscription: Subscription, packed: Any, trace: Trace) -> Any | None:
    """Unpack a message; None for malformed bytes, which are counted as a fact: they are not this request's."""
    try:
        return subscription.unpack(packed)
    except TransportError:
        trace.facts[UNREADABLE_N] = trace.facts.get(UNREADABLE_N, 0.0) + 1
        return None


def request_message(request: Request, images: Sequence[Any] = (), compressed_images: Sequence[Any] = ()) -> Any:
    return ros.message(
        ros.REQUEST,
        id=request.id,
        prompt=request.prompt,
        grammar=request.grammar,
        max_tokens=request.max_tokens,
        seed=request.seed,
        state=ros.float32_array(request.state),
        images=images,
        compressed_images=compressed_images,
    )


def token_message(request_id: str, piece: Piece, *, last: bool, error: str = "", marks: Sequence[Any] = ()) -> Any:
    """Turn a piece of an answer into s2a_msgs/Token; ``last`` ends the answer, with marks or an error."""
    actions = [piece] if isinstance(piece, Action) else []
    return ros.message(
        ros.TOKEN,
        id=request_id,
        index=piece.index,
        text="" if actions else piece.text,
        token=piece.id,
        actions=[ros.message(ros.ACTIONS, index=a.index, dims=len(a.values), values=a.values) for a in actions],
        last=last,
        error=error,
        marks=marks,
    )


def pieces_of(message: Any) -> list[Piece]:
    """Read s2a_msgs/Token: a token, or the actions that it brings; raises RequestFailed for what can be none."""
    if not message.actions:
        return [Token(message.index, message.text, message.token)]
    pieces: list[Piece] = []
    for actions in message.actions:
        if not actions.dims or len(actions.values) % actions.dims:
            raise RequestFailed(f"{len(actions.values)} numbers are not actions of {actions.dims}")
        pieces += actions_of(actions.values.reshape(-1, actions.dims), message.index + len(pieces))
    return pieces


def marks_message(request_id: str, remote: Remote) -> Any:
    return ros.message(
        ros.MARKS,
        id=request_id,
        clock=remote.clock,
        stages=[stage for stage, _ in remote.marks],
        stamps=ros.int64_array(stamp for _, stamp in remote.marks),
        token_stamps=ros.int64_array(remote.token_ns),
        frame_stamp=remote.frame_stamp_ns,
        frame_stages=[stage for stage, _ in remote.frame_marks],
        frame_stamps=ros.int64_array(stamp for _, stamp in remote.frame_marks),
        fact_names=list(remote.facts),
        fact_values=ros.float64_array(remote.facts.values()),
        provenance=provenance_message(remote.provenance),
    )


def provenance_message(facts: Mapping[str, str]) -> Any:
    return ros.message(ros.PROVENANCE, **{**Provenance().to_dict(), **facts})


def provenance_of(origin: Any) -> dict[str, str]:
    return {name: getattr(origin, name) for name in Provenance().to_dict()}


def remote_of(marks: Any) -> Remote:
    """Read a server's marks from s2a_msgs/Marks; raises RequestFailed for what can be none."""
    try:
        return Remote(
            clock=marks.clock,
            marks=list(zip(marks.stages, marks.stamps.tolist(), strict=True)),
            token_ns=marks.token_stamps.tolist(),
            frame_stamp_ns=int(marks.frame_stamp),
            frame_marks=list(zip(marks.frame_stages, marks.frame_stamps.tolist(), strict=True)),
            facts=dict(zip(marks.fact_names, marks.fact_values.tolist(), strict=True)),
            provenance=provenance_of(marks.provenance),
        ).check()
    except ValueError as error:
        raise RequestFailed(f"the server's marks are malformed: {error}") from error
