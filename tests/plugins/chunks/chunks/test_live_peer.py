"""Chunks live against a policy server that nobody here wrote."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from socket import create_connection
from time import monotonic

import pytest

from s2a_bench.plugins.chunks.chunks.config import ChunksConfig
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS
from s2a_bench.plugins.chunks.chunks.run import run_chunks
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress

POLICY = """
import asyncio, socket, time
import numpy as np
from policy_websocket import BasePolicy, WebsocketPolicyServer
class Policy(BasePolicy):
    def infer(self, obs):
        time.sleep(0.05)
        return {"actions": np.outer(np.arange(10), obs["observation/state"])}
    def reset(self): pass
with socket.create_server(("127.0.0.1", 0)) as found:
    port = found.getsockname()[1]
print(port, flush=True)
WebsocketPolicyServer(Policy(), host="127.0.0.1", port=port).serve_forever()
"""


@pytest.fixture
def policy_url() -> Iterator[str]:
    pytest.importorskip("policy_websocket")
    with subprocess.Popen([sys.executable, "-c", POLICY], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline())
        deadline = monotonic() + 30
        while True:
            try:
                create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                assert monotonic() < deadline
        yield f"ws://127.0.0.1:{port}"
        process.kill()


def test_a_policy_server_of_somebody_elses_moves_the_loop(policy_url: str, tmp_path: Path) -> None:
    config = ChunksConfig(
        live=True,
        seconds=2,
        horizon=10,
        modes="queue?trigger=4,sync",
        requests={"transports": "websocket", "url": policy_url, "size": "64x48", "state": 3, "warmup": 1},
    )
    run = read_run(run_chunks(config, tmp_path, NullProgress()))
    table = run.table(CHUNKS)
    assert table["agreement"].notna().all()
    assert (table["latency_s"] >= 0.05).all()
    assert (table.loc[table["mode"] == "sync", "stall_ticks"] > 0).all()
    assert run.origins.of(table["cell"].iloc[0]).engine == "unknown"
