"""Cells of runs of requests as ``--json`` and its schema hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from s2a_bench.stats import Summary
from s2a_bench.store.bounds import Count, about
from s2a_bench.trace import GROUPS


@dataclass(frozen=True, kw_only=True)
class RequestsCell:
    """What the cells of every run of requests say about themselves."""

    cell: Annotated[str, about("The name that ratios use.")]
    pipeline: str
    variant: str
    payload: str
    connection: str
    engine: str
    mode: Literal["request", "stream"]
    size: Annotated[str, {"pattern": "^[0-9]+x[0-9]+$"}]
    observation: Annotated[
        str, about("What each request brings: sizes, number of pictures, scaling, numbers of the robot's state.")
    ]
    answer: Annotated[Literal["tokens", "actions"], about("What answers are made of.")]
    profile: str | None
    emulated: Annotated[
        bool, about("True where a profile was replayed, or latencies were given: such numbers are not measured.")
    ]
    dummy: Annotated[
        bool | None, about("Whether the model's weights are dummies, random: its times are real, its words are not.")
    ] = None
    n: Annotated[Count, about("Samples that count: no warm-ups, no failures.")]
    errors: Count
    warmups: Count
    ttft_ms: Annotated[Summary | None, about("From the prompt: e2e without capture.")] = None
    itl_ms: Annotated[Summary | None, about("Every gap between a token and the next, as the client saw them.")] = None


@dataclass(frozen=True, kw_only=True)
class LatencyCell(RequestsCell):
    """One pipeline, stage by stage; what no sample has is an absent key."""

    residual_flagged: Annotated[Count, about("Samples whose residual is more than 5 % of e2e without inference.")]
    stages_ms: Annotated[dict[str, Summary], {"propertyNames": {"pattern": "^[a-z][a-z0-9_]*$"}}]
    groups_ms: Annotated[dict[str, Summary], {"propertyNames": {"enum": list(GROUPS)}}]
    e2e_ms: Summary | None = None
    e2e_without_inference_ms: Annotated[
        Summary | None, about("Absent behind a black box that does not tell its inference time.")
    ] = None
    e2e_without_model_ms: Annotated[
        Summary | None,
        about(
            "e2e less what the model computes up to the first token; preprocessing is left in. Of a llama-server: "
            "e2e less the prompt_ms it reports."
        ),
    ] = None
    frame_age_ms: Annotated[Summary | None, about("Age of the frame when inference starts.")] = None
    token_delay_ms: Annotated[Summary | None, about("From a token's leaving the engine to the client's seeing it.")] = (
        None
    )
    residual_share: Summary | None = None
