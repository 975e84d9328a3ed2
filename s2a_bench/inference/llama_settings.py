"""The llama engine's settings by their names on the command line, checked before anything is loaded."""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError

if TYPE_CHECKING:
    from s2a_bench.inference import EngineConfig

KV_TYPES = {"f32": 0, "f16": 1, "q8_0": 8, "q4_0": 2}
"""Type of the KV cache -> ggml's number (``ggml_type``)."""

FLASH_ATTENTION = {"auto": -1, "on": 1, "off": 0}
"""``llama_flash_attn_type``; auto: where the device has a kernel for it."""

SAMPLINGS: dict[str, dict[str, float]] = {
    "model": {"temp": 0.7, "top_p": 0.8, "top_k": 100, "min_p": 0.0},
    "greedy": {"temp": 0.0},
}
"""``model`` is that of llama.cpp's ``README-minicpmv2.6.md``, without the penalty on repetition, which breaks
structured output; ``greedy`` takes the likeliest token."""

LEAST_CONTEXT, LEAST_BATCH, LARGEST = 256, 32, 1 << 20
_QUANTISED = ("q8_0", "q4_0")


def check_settings(config: EngineConfig) -> None:
    """Raise UsageError, naming the flag, for a value or combination that llama.cpp would refuse."""
    for flag, value, known in (
        ("--kv-type", config.kv_type, KV_TYPES),
        ("--flash-attention", config.flash_attention, FLASH_ATTENTION),
        ("--sampling", config.sampling, SAMPLINGS),
    ):
        if value not in known:
            raise UsageError(f"{flag}: '{value}' is none of {', '.join(known)}")
    for flag, number, least in (
        ("--context", config.context, LEAST_CONTEXT),
        ("--batch", config.batch, LEAST_BATCH),
        ("--threads", config.threads, 0),
        ("--gpu-layers", config.gpu_layers, -1),
    ):
        if not least <= number <= LARGEST:
            raise UsageError(f"{flag}: {number} is not between {least} and {LARGEST}")
    if config.kv_type in _QUANTISED and config.flash_attention == "off":
        raise UsageError(
            f"--kv-type {config.kv_type} needs flash attention, which alone reads a quantised V cache; "
            "leave out --flash-attention off"
        )
