"""WebSocket and MessagePack as openpi's policy servers speak it: an observation goes up, a chunk of actions comes back.

``openpi`` answers with the chunk as a whole, ``openpi-stream`` with its actions as they are ready (partial frames, then
the final one). Our server serves both, and openpi's own clients; our client asks foreign servers too, which are told
what a template says (`transport.observation`).
"""

from __future__ import annotations

from collections.abc import Callable

from s2a_bench import extras
from s2a_bench.facts import INFER_MS, PAYLOAD_BYTES, RECONNECTS, Fact
from s2a_bench.transport import ACTIONS, Client, Handler, Server, Wiring
from s2a_bench.transport.listening import Listening
from s2a_bench.transport.websocket.options import WebsocketOptions

VARIANTS = ("openpi", "openpi-stream")
OPENPI, STREAM = VARIANTS
PACKAGES = ("msgpack", "websockets")
"""What the extra of its name brings."""
PREV_TOTAL_MS = Fact("prev_total_ms", "ms", "what a policy server says that the connection's last request took")
TIMING = {str(fact): fact for fact in (INFER_MS, PREV_TOTAL_MS)}
"""The keys of ``server_timing`` that are facts."""


class Websocket(Listening[WebsocketOptions]):
    """Policies over WebSocket, whole or streamed."""

    name = "websocket"
    options = WebsocketOptions
    variants = VARIANTS
    payloads = ("raw", "jpeg", "jpeg-preencoded", "png")
    schemes = WebsocketOptions.SCHEMES
    examines = "s2a_bench.transport.websocket.dangers:examine"
    stages = {
        "msgpack_pack": "pack",
        "frame_pack": "pack",  # the client masks what it sends (RFC 6455, 5.3)
        "frame_parse": "parse",
        "msgpack_parse": "parse",
    }
    tells = (PAYLOAD_BYTES, RECONNECTS, INFER_MS, PREV_TOTAL_MS)
    order = 20
    looks = {OPENPI: ("#000000", "-"), STREAM: ("#000000", "--")}
    compared_with = ("ros", "loopback")
    packages = (*PACKAGES, "uvloop")
    elsewhere = ("url",)
    serving = {"port": 8000}

    def client(self, wiring: Wiring[WebsocketOptions], alive: Callable[[], bool]) -> Client:
        """Prepare to ask the server at ``wiring.address``, a URL."""
        extras.need(self.name, *PACKAGES)
        from s2a_bench.transport.websocket.client import WebsocketClient

        return WebsocketClient(wiring, alive)

    def server(self, wiring: Wiring[WebsocketOptions], handler: Handler) -> Server:
        """Bind ``host:port``; raises PortInUse."""
        extras.need(self.name, *PACKAGES)
        from s2a_bench.transport.websocket.server import WebsocketServer

        return WebsocketServer(wiring, handler)

    def travels(self, variant: str, options: WebsocketOptions) -> tuple[str, ...]:  # noqa: ARG002 - of all transports
        """Return what a policy takes: pixels, unless its template says that it decodes files."""
        from s2a_bench.transport.observation import template_of

        if template_of(options.template).encoded:
            return self.payloads[1:]
        return self.payloads[:1] if options.url else self.payloads

    def answers(self, variant: str, options: WebsocketOptions) -> tuple[str, ...]:  # noqa: ARG002 - of all transports
        """Return actions, which policies answer with."""
        return (ACTIONS,)

    def takes_state(self, variant: str, options: WebsocketOptions) -> bool:  # noqa: ARG002 - of all transports
        """Whether the template has a place for the robot's state."""
        from s2a_bench.transport.observation import template_of

        return template_of(options.template).takes_state

    def check(self, variant: str, options: WebsocketOptions, *, mode: str, engine: str) -> None:  # noqa: ARG002
        """Refuse a key that is not there; raises MissingExtra too."""
        from s2a_bench.transport.credentials import read_key

        extras.need(self.name, *PACKAGES)
        read_key(options.api_key_env)

    def ready(self, wiring: Wiring[WebsocketOptions], address: str) -> str:
        """Return where policies are asked, and by whom."""
        key, everybody = wiring.options.api_key_env, wiring.options.no_auth
        whom = f" for who has the key in ${key}, /healthz for all" if key else " for all who reach it" * everybody
        return f"serving openpi's protocol at {address}, streamed at {address}{STREAM_PATH}{whom}"


STREAM_PATH = "/stream"
"""Where our server answers with partial and final frames; anywhere else with whole chunks."""
WEBSOCKET = Websocket()
