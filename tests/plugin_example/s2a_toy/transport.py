"""What the transport `toy` says about itself: messages over TCP, each with its length before it. Light to import."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

from s2a_bench.facts import PAYLOAD_BYTES, Fact
from s2a_bench.options import option
from s2a_bench.transport import SERVER, TransportOptions, Transport, Urls

TOY_MESSAGES = Fact("toy_messages", "messages", "messages of the answer")


class ToyOptions(TransportOptions):
    """The options of `toy`."""

    toy_port: int = option(0, "port of the toy server; 0: any free one", ge=0, le=65535, side=SERVER)


class Toy(Transport[ToyOptions]):
    """Length-prefixed messages over TCP: a JSON header, then the picture's pixels."""

    name = "toy"
    options = ToyOptions
    payloads = ("raw",)
    facts = (PAYLOAD_BYTES, TOY_MESSAGES)
    stages: ClassVar[Mapping[str, str]] = {"toy_frame": "pack", "toy_unframe": "parse"}
    style: ClassVar[Mapping[str, tuple[str, str]]] = {"": ("#8C564B", "-")}
    client_class = "s2a_toy.wire:ToyClient"
    server_class = "s2a_toy.wire:ToyServer"
    reader = "s2a_toy.tap:ToyReader"
    urls = Urls(("toy",))

    def addresses(self, options: ToyOptions) -> Iterable[str]:
        """Return the address of a new server: the port that was asked for, and any free one."""
        return f"127.0.0.1:{options.toy_port}", "127.0.0.1:0"


TOY = Toy()
