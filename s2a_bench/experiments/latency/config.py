"""What a latency run is asked."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.harness.config import RequestsConfig
from s2a_bench.inference import EngineConfig
from s2a_bench.options import group


class LatencyConfig(RequestsConfig):
    """The settings of a latency run: all of a run of requests, and of the engine what matters to transports."""

    COUNTS_TOKENS: ClassVar[str] = ""

    engine: EngineConfig = group(
        EngineConfig,
        only=(
            *("name", "profile", "gaps", "latency", "model", "mmproj", "threads", "gpu_layers", "context"),
            *("flash_attention", "answer", "horizon", "action_dim"),
        ),
    )
