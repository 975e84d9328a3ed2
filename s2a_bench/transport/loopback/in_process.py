"""A client that calls the server's handler, in process, without a copy.

The same conversions and the same hand-over as everywhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from threading import Event

from s2a_bench.errors import EngineError, RequestFailed, ServerDied
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Handler, TransportOptions, Wiring
from s2a_bench.transport.pictures import bgr_of, rgb_of
from s2a_bench.types import Piece, Request

_servers: dict[str, LoopbackServer] = {}
_numbers = count()


class LoopbackServer:
    def __init__(self, wiring: Wiring[TransportOptions], handler: Handler) -> None:
        self.address = wiring.address or f"loopback-{next(_numbers)}"
        self.handler = handler
        self._stopped = Event()
        _servers[self.address] = self

    def describe(self) -> dict[str, str | int]:
        return {"transport": "in process"}

    def serve(self) -> None:
        """Wait for `stop`; requests run on their clients' threads."""
        self._stopped.wait()

    def stop(self) -> None:
        _servers.pop(self.address, None)
        self._stopped.set()


class LoopbackClient(Client):
    def __init__(self, wiring: Wiring[TransportOptions], alive: Callable[[], bool]) -> None:
        del alive  # a server in this process lives as long as it is registered
        self._address = wiring.address

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        server = _servers.get(self._address)
        if server is None:
            raise ServerDied(f"no loopback server '{self._address}' in this process")
        images = tuple(rgb_of(bgr_of(frame, trace), trace) for frame in request.images)
        handed = replace(request, images=images)
        served = Trace()
        trace.mark("hand_over")
        tokens = server.handler(handed, served)
        try:
            for index, token in enumerate(tokens):
                if not index:
                    trace.mark("return")
                yield token
        except EngineError as error:
            raise RequestFailed(str(error)) from error
        trace.receive(served.to_remote())
