"""The llama engine's settings by their names, and the bounds of its numbers."""

from __future__ import annotations

KV_TYPES = {"f32": 0, "f16": 1, "q8_0": 8, "q4_0": 2}
"""Type of the KV cache -> ggml's number (``ggml_type``)."""

FLASH_ATTENTION = {"auto": -1, "on": 1, "off": 0}
"""``llama_flash_attn_type``; auto: where the device has a kernel for it. Runs measure instead."""

SAMPLINGS: dict[str, dict[str, float]] = {
    "model": {"temp": 0.7, "top_p": 0.8, "top_k": 100, "min_p": 0.0},
    "greedy": {"temp": 0.0},
}
"""``model`` is that of llama.cpp's ``README-minicpmv2.6.md``, without the penalty on repetition, which breaks
structured output; ``greedy`` takes the likeliest token."""

PENALTY_LAST_N, LAST_N = "penalty_last_n", 64
"""Of how many last tokens repetition is punished: its name in `Request.sampling`, and what it is unless told."""

SAMPLER_ARGUMENTS = {
    **{name: name for name in ("temp", "top_k", "top_p", "min_p", "typical_p", "mirostat_eta", "mirostat_tau")},
    "mirostat": "mirostat_mode",
    "penalty_repeat": "repeat_penalty",
    "penalty_freq": "frequency_penalty",
    "penalty_present": "presence_penalty",
}
"""Name in `Request.sampling` -> the library's name."""

LEAST_CONTEXT, LEAST_BATCH, LARGEST = 256, 32, 1 << 20
