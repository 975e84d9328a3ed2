"""WebSocket and MessagePack as openpi's policy servers speak it: an observation goes up, a chunk of actions comes back.

``openpi`` answers with the chunk as a whole, ``openpi-stream`` with its actions as they are ready (partial frames, then
the final one). Our server serves both, and openpi's own clients; our client also queries foreign servers, with
observations from a template (`observation`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from s2a_bench.facts import INFER_MS, PAYLOAD_BYTES, RECONNECTS, Fact
from s2a_bench.plugins.policy_servers.policies import PolicyTransport, TemplateOptions
from s2a_bench.transport import Urls, Wiring
from s2a_bench.transport.access import WebOptions
from s2a_bench.transport.listening import ListeningTransport

OPENPI, STREAM = "openpi", "openpi-stream"
PREV_TOTAL_MS = Fact(
    "prev_total_ms", "ms", "duration of the connection's last request, as the policy server reports it"
)
TIMING = {str(fact): fact for fact in (INFER_MS, PREV_TOTAL_MS)}
"""The keys of ``server_timing`` that are facts."""


class WebsocketOptions(WebOptions, TemplateOptions):
    SCHEMES: ClassVar[tuple[str, ...]] = ("ws", "wss")

    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {"port": 8000}


class Websocket(ListeningTransport[WebsocketOptions], PolicyTransport[WebsocketOptions]):
    name = "websocket"
    options = WebsocketOptions
    variants = (OPENPI, STREAM)
    urls = Urls(WebsocketOptions.SCHEMES, examine="s2a_bench.plugins.policy_servers.websocket.client:examine")
    needs = ("websocket", "msgpack", "websockets")
    client_class = "s2a_bench.plugins.policy_servers.websocket.client:WebsocketClient"
    server_class = "s2a_bench.plugins.policy_servers.websocket.server:WebsocketServer"
    reader = "s2a_bench.plugins.policy_servers.websocket.tap:WebsocketReader"
    reads_server = ("path", "greets", "text_keys", "answer", "reset", "idle_s", "image_maps")
    facts = (PAYLOAD_BYTES, RECONNECTS, INFER_MS, PREV_TOTAL_MS)
    order = 20
    style = {OPENPI: ("#000000", "-"), STREAM: ("#000000", "--")}
    packages = ("msgpack", "websockets")

    def ready(self, wiring: Wiring[WebsocketOptions]) -> str:
        address = wiring.address
        whom = wiring.options.callers("have the key in {}, /healthz for all")
        return f"serving openpi's protocol at {address}, streamed at {address}{STREAM_PATH}{whom}"


STREAM_PATH = "/stream"
"""The path at which our server answers with partial and final frames; at any other with whole chunks."""
WEBSOCKET = Websocket()
