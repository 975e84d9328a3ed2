"""What the WebSocket transport can be told."""

from __future__ import annotations

from typing import ClassVar

from s2a_bench.options import option
from s2a_bench.transport.listening import ListeningOptions
from s2a_bench.transport.observation import DEFAULT, TemplateName


class WebsocketOptions(ListeningOptions):
    """How our policy server is reached, or somebody else's is asked."""

    SCHEMES: ClassVar[tuple[str, ...]] = ("ws", "wss")

    template: TemplateName = option(DEFAULT, "what the policy is told: a template's name, or a TOML or JSON file")
