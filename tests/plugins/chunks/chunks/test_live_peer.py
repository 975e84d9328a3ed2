"""Chunks live against a policy server that nobody here wrote."""

from pathlib import Path

from s2a_bench.plugins.chunks.chunks.config import ChunksConfig
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS
from s2a_bench.plugins.chunks.chunks.run import run_chunks
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from tests.servers.policy_websocket import policy_server


def test_a_policy_server_of_somebody_elses_moves_the_loop(tmp_path: Path) -> None:
    requests = {"transports": "websocket", "size": "64x48", "state": 3, "warmup": 1}
    with policy_server() as url:
        config = ChunksConfig(
            live=True, seconds=2, horizon=10, modes="queue?trigger=4,sync", requests={**requests, "url": url}
        )
        run = read_run(run_chunks(config, tmp_path, NullProgress()))
    table = run.table(CHUNKS)
    assert table["agreement"].notna().all()
    assert (table["latency_s"] >= 0.05).all()
    assert (table.loc[table["mode"] == "sync", "stall_ticks"] > 0).all()
    assert run.origins.of(table["cell"].iloc[0]).engine == "unknown"
