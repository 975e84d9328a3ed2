"""Who is asked for chunks live: the requests of a latency run, as far as they concern policies."""

from __future__ import annotations

from typing import ClassVar, Final

from s2a_bench import extras
from s2a_bench.harness.plan import FirstVariants, RequestsConfig
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Names, group, option
from s2a_bench.transport.http import BINARY, HTTP
from s2a_bench.transport.websocket import WEBSOCKET

WITHOUT: Final = f"{HTTP.name}/{BINARY}"
"""What carries actions with no extra installed."""

SHOWN: Final = (
    *("transports", "variants", "options", "url", "engine", "payload", "source", "size", "cameras", "resize", "state"),
    *("prompt", "warmup", "timeout_s", "deadline_s", "sample_resources_hz", "nonce"),
)
"""The options that are flags of `chunks`."""


class LiveRequests(RequestsConfig):
    """The requests of a control loop."""

    COUNTS_TOKENS: ClassVar[str] = ""

    transports: Names = option(
        (WEBSOCKET.name if all(map(extras.installed, WEBSOCKET.packages)) else WITHOUT,),
        "transports as in latency; several with commas, each with every mode "
        f"[default: {WEBSOCKET.name}, {WITHOUT} where its packages are not installed]",
        flag="transport",
    )
    variants: FirstVariants = group(FirstVariants)
    engine: EngineConfig = group(EngineConfig, only=("name", "profile", "gaps", "action_dim"))
    warmup: int = option(5, "requests before a cell's loop starts, kept and marked", ge=1, le=10**6)
    sample_resources_hz: float = option(
        0.0, "readings a second of CPU, memory, GPU and power beside the run; 0: none", flag="sample-resources", ge=0
    )

    def check(self) -> None:
        """Refuse what makes no sense; nothing where nobody is asked for anything, as in virtual time."""
        if self.model_fields_set:
            super().check()
