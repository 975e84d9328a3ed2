"""Facts: numbers about a request besides its marks.

A transport, a dialect, an engine or the harness declares the facts that it reports. This module declares those with
several sources, and those that another room reads.
"""

from __future__ import annotations

from collections.abc import Iterable


class Fact(str):
    """The name of a fact, with its unit and its meaning; a key of ``Trace.facts``, whose values are floats."""

    __slots__ = ("about", "unit")

    about: str
    unit: str

    def __new__(cls, name: str, unit: str = "", about: str = "") -> Fact:  # noqa: PYI034 - Self is typing's since 3.11
        """Name a fact; ``about`` is one line, ``unit`` empty for a pure number."""
        fact = super().__new__(cls, name)
        fact.about, fact.unit = about, unit
        return fact


def facts_json(facts: Iterable[Fact]) -> dict[str, dict[str, str]]:
    return {str(fact): {"unit": fact.unit, "about": fact.about} for fact in facts}


PROMPT_N = Fact("prompt_n", "tokens", "prompt that was evaluated, pictures included")
CACHE_N = Fact("cache_n", "tokens", "prompt that came from a cache")
PROMPT_MS = Fact("prompt_ms", "ms", "evaluating the prompt, pictures included")
PROMPT_EVAL_MS = Fact("prompt_eval_ms", "ms", "the language model's part of `prompt_ms`")
PREPROCESS_MS = Fact("preprocess_ms", "ms", "of `prompt_ms`, before the model: template, slicing, resizing, tokenising")
VISION_ENCODE_MS = Fact(
    "vision_encode_ms", "ms", "of `prompt_ms`, the vision tower, over all slices; absent without picture"
)
FIRST_DECODE_MS = Fact("first_decode_ms", "ms", "the first token to the second: the first step after the prompt")
PREDICTED_N = Fact("predicted_n", "tokens", "generated answer")
PREDICTED_MS = Fact("predicted_ms", "ms", "generating the answer, from the end of the prompt to the last token")
END_N = Fact("end_n", "tokens", "of `predicted_n`, the last that ends the answer and is never shown")
PREDICTED_STEPS = Fact("predicted_steps", "tokens", "what `predicted_ms` covers, where it is not `predicted_n`")
USAGE_ZERO = Fact("usage_zero", "", "1 where the server's usage was zeros alone, which tell nothing")
THINKING_N = Fact("thinking_n", "tokens", "what the model said to itself before the answer")
PAYLOAD_BYTES = Fact("payload_bytes", "bytes", "what the payload weighs on the wire")
RECONNECTS = Fact("reconnects", "", "1 where the server had closed the kept connection")
LATENCY_DRAWN_MS = Fact("latency_drawn_ms", "ms", "from the request to the whole answer, as `--latency` has it")
INFER_MS = Fact("infer_ms", "ms", "what a policy server says that its policy took")
CAMERA_FRAMES = Fact("camera_frames", "frames", "camera frames that the server had received when it answered")
CAMERA_AGE_MS = Fact("camera_age_ms", "ms", "start of inference less reception, of the frame that the server had kept")
CAMERA_SIM_AGE_MS = Fact("camera_sim_age_ms", "ms", "the time on /clock less its header's stamp: `use_sim_time`")
CAMERA_STAMP_AGE_MS = Fact("camera_stamp_age_ms", "ms", "start of inference less its header's stamp, by wall clock")
STALE_FRAMES = Fact("stale_frames", "frames", "1 where it was too old to be used, so that the request failed")
CAMERA_FACTS = (CAMERA_FRAMES, CAMERA_AGE_MS, CAMERA_STAMP_AGE_MS, CAMERA_SIM_AGE_MS, STALE_FRAMES)
FRAMES_PUBLISHED = Fact("frames_published", "frames", "camera frames sent, up to the one that the answer is about")
FRAMES_LOST = Fact("frames_lost", "frames", "`frames_published` less `camera_frames`")
HEADERS_OFF_MS = Fact("headers_off_ms", "ms", "response headers to first token, less `prompt_ms`")

LLAMA: tuple[Fact, ...] = (
    *(PROMPT_N, PROMPT_MS, PREPROCESS_MS, VISION_ENCODE_MS, PROMPT_EVAL_MS),
    *(FIRST_DECODE_MS, PREDICTED_N, PREDICTED_MS),
)
"""The facts of the llama engine, in this process and behind the package's servers."""
