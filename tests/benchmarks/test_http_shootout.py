"""The shoot-out compares what is installed."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_every_pair_that_is_here_is_in_the_table() -> None:
    command = [sys.executable, "-m", "benchmarks.http_shootout", "--rounds", "1", "--size", "64x48"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    for pair in (
        "FastAPI on uvicorn | httpx",
        "httptools, threads | http.client",
        "http.server, threads | http.client",
    ):
        assert f"| {pair} | " in done.stdout
