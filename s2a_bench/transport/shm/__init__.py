"""The floor of a wire between two processes of one machine: shared memory, and a packet that says where to look."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.options import option
from s2a_bench.transport import Client, Handler, Server, Transport, Wiring
from s2a_bench.transport.options import SERVER, Options


class ShmOptions(Options):
    """The options of `shm`."""

    socket: str = option("", "path of the socket where shared memory is handed over [default: a new one]", side=SERVER)


class Shm(Transport[ShmOptions]):
    """Request, picture and tokens lie in shared memory; nothing but their places goes through the kernel."""

    name = "shm"
    options = ShmOptions
    payloads = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
    stages: ClassVar[Mapping[str, str]] = {"header_pack": "pack", "header_parse": "parse"}
    tells = (PAYLOAD_BYTES,)
    order = 90
    looks: ClassVar[Mapping[str, tuple[str, str]]] = {"": ("#E69F00", "--")}

    def client(self, wiring: Wiring[ShmOptions], alive: Callable[[], bool]) -> Client:
        """Connect to the server at ``wiring.address``."""
        from s2a_bench.transport.shm.client import ShmClient

        return ShmClient(wiring, alive)

    def server(self, wiring: Wiring[ShmOptions], handler: Handler) -> Server:
        """Bind a server."""
        from s2a_bench.transport.shm.server import ShmServer

        return ShmServer(wiring, handler)

    def bind(self, options: ShmOptions, taken: Sequence[str]) -> str:
        """Return the socket of a new server: the one that was asked for, a new one for a second server."""
        return "" if taken else options.socket


SHM = Shm()
