"""The options of a latency run."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.harness.config import RequestsConfig
from s2a_bench.inference import OF_MODEL, EngineConfig
from s2a_bench.options import group, option
from s2a_bench.transport import JPEG, PAYLOADS, RAW, Payloads


class LatencyConfig(RequestsConfig):
    """The options of a latency run: those of requests, and of the engine those that matter to transports."""

    COUNTS_TOKENS: ClassVar[str] = ""

    payload: Payloads = option(
        (),
        f"how pictures are sent: {', '.join(PAYLOADS)}; several with commas, each in cells of its own "
        "[default: raw,jpeg; quick, stream: raw]",
    )

    engine: EngineConfig = group(
        EngineConfig,
        only=(
            *("name", "profile", "gaps", "latency", *OF_MODEL, "threads", "context"),
            *("flash_attention", "answer", "horizon", "action_dim"),
        ),
    )

    think_s: float = option(0.0, "seconds between an answer and its cell's next request", flag="think", ge=0, le=3600)

    @property
    def usual_payloads(self) -> tuple[str, ...]:
        """Raw; and JPEG, unless the run is quick or streams, or a pipeline names its payload."""
        named = any("payload=" in name for name in self.names)
        return (RAW,) if self.quick or self.mode == "stream" or named else (RAW, JPEG)
