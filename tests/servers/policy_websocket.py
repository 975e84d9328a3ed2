"""Policy servers that answer as a test says, and one that nobody here wrote, policy_websocket's."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from socket import create_connection
from threading import Thread
from typing import Any

import pytest
from websockets.sync.server import serve

from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from tests.waiting import until

POLICY = """
import socket, time
import numpy as np
from policy_websocket import BasePolicy, WebsocketPolicyServer
class Policy(BasePolicy):
    def infer(self, obs):
        if obs["prompt"] == "fail":
            raise ValueError("no such task")
        assert obs["observation/image"].ndim == 3
        time.sleep(0.05)
        return {"actions": np.outer(np.arange(10), obs["observation/state"])}
    def reset(self): pass
with socket.create_server(("127.0.0.1", 0)) as found:
    port = found.getsockname()[1]
print(port, flush=True)
WebsocketPolicyServer(Policy(), host="127.0.0.1", port=port, metadata={"robot": "none"}).serve_forever()
"""


@contextmanager
def policy_server() -> Iterator[str]:
    """Serve chunks of 10 actions, each after 50 ms; yields the address."""
    pytest.importorskip("policy_websocket")
    with subprocess.Popen([sys.executable, "-c", POLICY], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        port = int(process.stdout.readline())

        def answers() -> bool:
            try:
                create_connection(("127.0.0.1", port)).close()
            except OSError:
                return False
            return True

        until(answers)
        yield f"ws://127.0.0.1:{port}"
        process.kill()


@contextmanager
def handled_by(handle: Callable[[Any], None], greeting: Any = None, **more: Any) -> Iterator[str]:
    """A server that greets each connection, and then handles it by a function."""

    def greeted(socket: Any) -> None:
        if greeting is not None:
            socket.send(packb(greeting))
        handle(socket)

    with serve(greeted, "127.0.0.1", 0, **{"compression": None, "max_size": None, **more}) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield "ws://{}:{}".format(*server.socket.getsockname()[:2])
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def relative(
    answer: Callable[[Any], Any], greeting: Any = (("model", "pi0"),), **packing: bool
) -> Iterator[tuple[str, list[Any]]]:
    """A server that answers each message by a function: its address, and the paths and messages that came.

    An empty message has no answer; a text and bytes are sent as they are.
    """
    heard: list[Any] = []

    def handle(socket: Any) -> None:
        heard.append(socket.request.path)
        for message in socket:
            heard.append(unpackb(message) if message else b"")
            if message:
                said = answer(heard[-1])
                socket.send(said if isinstance(said, (str, bytes)) else packb(said, **packing))

    with handled_by(handle, greeting if greeting is None else dict(greeting)) as address:
        yield address, heard
