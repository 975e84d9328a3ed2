"""The pipeline without a wire: the floor that other transports are compared with."""

from __future__ import annotations

from collections.abc import Callable

from s2a_bench.transport import Client, Handler, Server, Transport, Wiring
from s2a_bench.transport.options import Options


class Loopback(Transport[Options]):
    """A call within the process; no picture travels, whatever the payload is."""

    name = "loopback"
    for_policies = True
    options = Options
    stages = {"hand_over": "parse"}  # making of the request what the handler takes
    order = 100
    looks = {"": ("#009E73", ":")}
    compared_with = ()
    in_process = True

    def client(self, wiring: Wiring[Options], alive: Callable[[], bool]) -> Client:
        """Find the handler that is registered under ``wiring.address``."""
        from s2a_bench.transport.loopback.in_process import LoopbackClient

        return LoopbackClient(wiring, alive)

    def server(self, wiring: Wiring[Options], handler: Handler) -> Server:
        """Register the handler under ``wiring.address``, or a new name without one."""
        from s2a_bench.transport.loopback.in_process import LoopbackServer

        return LoopbackServer(wiring, handler)


LOOPBACK = Loopback()
