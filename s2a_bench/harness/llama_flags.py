"""The engine's settings as the flags that llama.cpp's own programs share."""

from __future__ import annotations

import os

from s2a_bench.inference import EngineConfig

_ALL_LAYERS = 999


def llama_flags(engine: EngineConfig) -> list[str]:
    """Return flags that make ``llama-server`` and ``llama-bench`` compute as our own engine does.

    Every CPU this process may use, and nothing on a GPU unless told.
    """
    batch = str(min(engine.batch, engine.context))
    flags = {
        "--model": str(engine.model),
        "--threads": str(engine.threads or len(os.sched_getaffinity(0))),
        "--n-gpu-layers": str(engine.gpu_layers if engine.gpu_layers >= 0 else _ALL_LAYERS),
        "--batch-size": batch,
        "--ubatch-size": batch,
        "--cache-type-k": engine.kv_type,
        "--cache-type-v": engine.kv_type,
        "--flash-attn": engine.flash_attention,
    }
    return [word for pair in flags.items() for word in pair]
