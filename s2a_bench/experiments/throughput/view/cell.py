"""A cell of a throughput run, and the reference beside it, as ``--json`` and its schema hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from s2a_bench.experiments.latency.view.cell import RequestsCell
from s2a_bench.stats import Summary
from s2a_bench.store.bounds import Count, about


@dataclass(frozen=True)
class Position:
    """The tokens of an answer from the first to the last, counted from 0."""

    first: Count
    last: Count
    decode_tokens_per_s: Summary


@dataclass(frozen=True, kw_only=True)
class ThroughputCell(RequestsCell):
    """One pipeline in tokens a second; what no request has is an absent key."""

    t_eval: Annotated[
        Literal["engine", "client"],
        about("Who told T_eval: the engine, or nobody, so that decode_tokens_per_s stands for tokens_per_s."),
    ]
    tokens_per_s: Annotated[
        Summary | None,
        about("The paper's: N_tokens / T_eval, in the engine: from the end of the prompt to the last token."),
    ] = None
    decode_tokens_per_s: Annotated[
        Summary | None, about("(n - 1) / (t_last - t_first), as the client saw the tokens.")
    ] = None
    prompt_ms: Annotated[Summary | None, about("Picture and prompt in the engine, up to the first token's logits.")] = (
        None
    )
    preprocess_ms: Annotated[
        Summary | None, about("The part of prompt_ms before the model: template, slicing, resizing, tokenising.")
    ] = None
    vision_encode_ms: Annotated[Summary | None, about("The vision tower's part of prompt_ms, over all slices.")] = None
    image_ms: Annotated[
        Summary | None, about("The part of prompt_ms outside the language model: slicing, vision tower, tokenising.")
    ] = None
    prompt_eval_ms: Annotated[Summary | None, about("The language model's part of prompt_ms.")] = None
    first_decode_ms: Annotated[
        Summary | None, about("The first token to the second in the engine: the first step after the prompt.")
    ] = None
    prompt_tokens: Annotated[Summary | None, about("Prompt tokens evaluated, pictures included.")] = None
    prefill_tokens_per_s: Annotated[Summary | None, about("prompt_tokens / prompt_ms.")] = None
    tokens_per_joule: Annotated[
        Summary | None, about("Tokens of the answer per joule of the whole request, where power can be read.")
    ] = None
    positions: Annotated[list[Position], about("Decode rate by the place in the answer.")]


@dataclass(frozen=True)
class Reference:
    """llama.cpp's llama-bench on the same model file, one run a block."""

    program: Literal["llama-bench"]
    command: list[str]
    depths: Annotated[list[Count], about("Tokens in the context before those that were timed.")]
    decode_tokens_per_s: Summary
