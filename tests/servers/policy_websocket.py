"""A policy server that nobody here wrote, policy_websocket's, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from socket import create_connection

import pytest

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
