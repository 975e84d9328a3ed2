"""How long a picture takes there and a chunk back over WebSocket, client by client and server by server.

``python -m benchmarks.websocket_shootout [ROUNDS]``: 921,600 random bytes go up, 3,600 come back, uncompressed, on
loopback, each server a process of its own; blocks of all pairs take turns. Wants a quiet machine, and the extra
websocket.
"""

from __future__ import annotations

import asyncio
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing import Process
from statistics import median, quantiles
from typing import Any, Final

import numpy as np
import uvloop

from s2a_bench.clock import now_ns
from s2a_bench.errors import ServerDied
from s2a_bench.testing.transport import Recorder, wiring
from s2a_bench.transport import open_server
from s2a_bench.transport.bounds import Bounds
from s2a_bench.transport.websocket.codec import packb
from s2a_bench.transport.websocket.link import Link

UP: Final = np.random.default_rng(0).integers(0, 256, 921_600, np.uint8).tobytes()
DOWN: Final = bytes(3600)
BLOCK: Final = 20
OURS: Final = packb({"image": np.frombuffer(UP, np.uint8).reshape(480, 640, 3)})


def threads(port: int) -> None:
    """Serve with websockets' threads."""
    from websockets.sync.server import serve

    def answer(connection: Any) -> None:
        for _ in connection:
            connection.send(DOWN)

    with serve(answer, "127.0.0.1", port, compression=None, max_size=None) as server:
        server.serve_forever()


def loop(port: int) -> None:
    """Serve with websockets' asyncio on uvloop."""
    from websockets.asyncio.server import serve

    async def answer(connection: Any) -> None:
        async for _ in connection:
            await connection.send(DOWN)

    async def run() -> None:
        async with serve(answer, "127.0.0.1", port, compression=None, max_size=None) as server:
            await server.serve_forever()

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(run())


def ours(port: int) -> None:
    """Serve with our own server, MessagePack, queue and all, and a chunk of 120 actions."""
    open_server(wiring("websocket", f"127.0.0.1:{port}"), Recorder([np.zeros(7, np.float32)] * 120)).serve()


def by_library(port: int, stack: ExitStack, message: bytes) -> Callable[[], object]:
    """Ask with websockets' threaded client, as openpi's does."""
    from websockets.sync.client import connect

    link = stack.enter_context(connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None))

    def ask() -> object:
        link.send(message)
        return link.recv()

    if message is OURS:
        link.recv()
    return ask


def by_link(port: int, stack: ExitStack, message: bytes) -> Callable[[], object]:
    """Ask with our own client's connection."""
    link = Link(f"ws://127.0.0.1:{port}", {}, Bounds("it", 3600, 1 << 20), 60)
    stack.callback(link.close)

    def ask() -> object:
        link.send(link.pack(message))
        return link.receive()

    if message is OURS:
        link.receive()
    return ask


def main(rounds: int) -> None:
    """Print the medians."""
    times: dict[str, list[float]] = {}
    with ExitStack() as stack:
        asks: dict[str, Callable[[], object]] = {}
        for serve in (threads, loop, ours):
            with socket.create_server(("127.0.0.1", 0)) as found:
                port = found.getsockname()[1]
            process = Process(target=serve, args=(port,), daemon=True)
            process.start()
            stack.callback(process.kill)
            message = OURS if serve is ours else UP
            for client in (by_library, by_link):
                asks[f"server {serve.__name__}, client {client.__name__}"] = _opened(client, port, stack, message)
        for turn in range(rounds + 1):
            for name, ask in asks.items():
                for _ in range(BLOCK):
                    began = now_ns()
                    ask()
                    if turn:  # the first warms up
                        times.setdefault(name, []).append((now_ns() - began) / 1e6)
    for name, values in times.items():
        print(f"{name:38} {median(values):6.3f} ms, p90 {quantiles(values, n=10)[-1]:6.3f}")


def _opened(client: Callable[..., Callable[[], object]], port: int, stack: ExitStack, message: bytes) -> Any:
    """Connect as soon as the server listens."""
    for _ in range(200):
        try:
            return client(port, stack, message)
        except (ServerDied, OSError):
            threading.Event().wait(0.05)
    raise SystemExit("a server did not come up")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
