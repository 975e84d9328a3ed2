"""What a latency run is asked, and what is shown of it."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.experiments.paper import AgainstPaper
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.inference import EngineConfig
from s2a_bench.options import group, option

WIRES = {"bgr": "raw", "compressed": "jpeg"}
"""Values of the former --wire -> those of --payload."""


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
    wire: str = option("", "gone: see --payload", hidden=True)

    def check(self) -> None:
        """Refuse what makes no sense, and the former name of the payload."""
        if self.wire:
            now = WIRES.get(self.wire, self.wire)
            raise UsageError(f"`wire` is gone: write `payload` {now}, or for ROS alone `transport` 'ros?payload={now}'")
        super().check()


class LatencyView(AgainstPaper):
    """What is drawn and printed besides."""

    verbose: bool = option(False, "also what measuring costs, and the environment")
