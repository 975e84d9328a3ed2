"""What the transport `toy` says about itself: messages over TCP, each with its length before it. Light to import."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from s2a_bench.facts import PAYLOAD_BYTES, Fact
from s2a_bench.options import option
from s2a_bench.transport import Client, Handler, Server, Transport, Wiring
from s2a_bench.transport.options import SERVER, Options


TOY_MESSAGES = Fact("toy_messages", "messages", "messages of the answer")


class ToyOptions(Options):
    """The options of `toy`."""

    toy_port: int = option(0, "port of the toy server; 0: any free one", ge=0, le=65535, side=SERVER)


class Toy(Transport[ToyOptions]):
    """Length-prefixed messages over TCP: a JSON header, then the picture's pixels."""

    name = "toy"
    options = ToyOptions
    payloads = ("raw",)
    tells = (PAYLOAD_BYTES, TOY_MESSAGES)
    stages: ClassVar[Mapping[str, str]] = {"toy_frame": "pack", "toy_unframe": "parse"}
    looks: ClassVar[Mapping[str, tuple[str, str]]] = {"": ("#8C564B", "-")}

    def client(self, wiring: Wiring[ToyOptions], alive: Callable[[], bool]) -> Client:
        """Connect to the server at ``wiring.address``."""
        from s2a_toy.wire import ToyClient

        return ToyClient(wiring, alive)

    def server(self, wiring: Wiring[ToyOptions], handler: Handler) -> Server:
        """Bind a server."""
        from s2a_toy.wire import ToyServer

        return ToyServer(wiring, handler)

    def bind(self, options: ToyOptions, taken: Any) -> str:
        """Return the address of a new server: the port that was asked for, any free one for a second server."""
        return f"127.0.0.1:{0 if taken else options.toy_port}"


TOY = Toy()
