"""The options of a latency run."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.harness.config import RequestsConfig
from s2a_bench.inference import EngineConfig
from s2a_bench.options import group, option
from s2a_bench.transport import PAYLOADS, Payloads


class LatencyConfig(RequestsConfig):
    """The settings of a latency run: all of a run of requests, and of the engine what matters to transports."""

    COUNTS_TOKENS: ClassVar[str] = ""

    payload: Payloads = option(
        (),
        f"how a picture travels: {', '.join(PAYLOADS)}; several with commas, each in cells of its own "
        "[default: raw,jpeg; quick, stream: raw]",
    )

    engine: EngineConfig = group(
        EngineConfig,
        only=(
            *("name", "profile", "gaps", "latency", "model", "mmproj", "threads", "gpu_layers", "context"),
            *("flash_attention", "answer", "horizon", "action_dim"),
        ),
    )

    @property
    def usual_payloads(self) -> tuple[str, ...]:
        """Return raw, and JPEG as a second block where there is time and no name has a payload of its own."""
        named = any("payload=" in name for name in self.names)
        return ("raw",) if self.quick or self.mode == "stream" or named else ("raw", "jpeg")
