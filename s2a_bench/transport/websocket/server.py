"""Our policy server: openpi's protocol on uvloop, whose loop answers `/healthz` whatever the engine does."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import uvloop
import websockets.version

from s2a_bench.transport import Handler, Wiring
from s2a_bench.transport.listening import bound_socket
from s2a_bench.transport.turns import Queued
from s2a_bench.transport.websocket.call import Office, metadata_of
from s2a_bench.transport.websocket.codec import packb
from s2a_bench.transport.websocket.door import Door, House
from s2a_bench.transport.websocket.options import WebsocketOptions

GRACE_S = 1.0
CLOSING_S = 0.01
"""Time for the loop to close what is broken off."""


class WebsocketServer:
    """A server on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[WebsocketOptions], handler: Handler) -> None:
        """Bind ``host:port`` of ``wiring.address`` or what `address` was, without it 127.0.0.1 and any port.

        Raises PortInUse, and UsageError where others than this machine would need no key and nobody said so.
        """
        self._socket, key = bound_socket(wiring.address, "ws", wiring.options)
        self.address = "ws://{}:{}".format(*self._socket.getsockname())
        queued = Queued.around(handler, wiring.limits)
        self._house = House(Office(queued, wiring.limits), key, packb(metadata_of(queued)))
        self._loop = uvloop.new_event_loop()
        self._stopped = asyncio.Event()

    def describe(self) -> dict[str, str | int]:
        """Say what serves."""
        return {"server": "websockets", "version": websockets.version.version, "loop": "uvloop"}

    def serve(self) -> None:
        """Serve until stopped."""
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        server = await self._loop.create_server(lambda: Door(self._house, self._loop), sock=self._socket)
        async with server:
            await self._stopped.wait()
            server.close()
            for _ in range(round(GRACE_S / CLOSING_S)):
                if not any(door.busy for door in self._house.doors):
                    break
                await asyncio.sleep(CLOSING_S)
            for door in list(self._house.doors):
                door.hang_up()
            self._house.office.threads.shutdown(wait=False, cancel_futures=True)
            await asyncio.sleep(CLOSING_S)

    def stop(self) -> None:
        """Finish the requests under way, for a second at most."""
        with suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._stopped.set)
