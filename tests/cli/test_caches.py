"""Servers that keep what they made of a picture: a run never hits, one with its nonce does, and that is a warning."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.testing.transport import RecordingHandler
from s2a_bench.types import Request, Token
from tests.cli.program import called
from tests.servers.sockets import Received, head, serving
from tests.servers.speakers import Cloud, answering

SMALL = ["--size", "64x48", "--requests", "4", "--warmup", "1", "--max-tokens", "3", "--data-only", "--json"]


class Caching(Cloud):
    """A server that keeps pictures by a hash of their pixels, as vLLM does; its metrics count the hits."""

    def __init__(self) -> None:
        self.seen: set[int] = set()
        self.hits = 0

    def read(self, received: Received) -> Request:
        request = super().read(received)
        (image,) = request.images
        key = hash(image.data.tobytes())
        self.hits += key in self.seen
        self.seen.add(key)
        return request

    def usage(self, tokens: list[Token]) -> dict[str, Any]:
        return {"usage": {"prompt_tokens": 12, "completion_tokens": len(tokens)}}


@contextmanager
def caching(server: Caching) -> Iterator[str]:
    chat = answering(server, RecordingHandler(["go", "_to"]))

    def reply(received: Received) -> Any:
        if received.path == "/metrics":
            counted = (
                f'# TYPE vllm:mm_cache_hits_total counter\nvllm:mm_cache_hits_total{{engine="0"}} {server.hits}.0\n'
            )
            return [head(kind="text/plain"), counted.encode()]
        if received.path == "/v1/models":
            return [head(kind="application/json"), b'{"data":[{"id":"first"},{"id":"second"}]}']
        return chat(received)

    with serving(reply) as url:
        yield url


def run(url: str, *arguments: str, output: Path) -> dict[str, Any]:
    done = called("latency", "--transport", "http", "--url", url, *SMALL, *arguments, "--output", output)
    return {**json.loads(done.stdout), "stderr": done.stderr}


def codes(result: dict[str, Any]) -> set[str]:
    return {warning["code"] for warning in result["warnings"]}


@pytest.mark.slow
def test_the_nonce_of_a_run_repeats_its_pictures_and_the_guard_sees_the_hits(tmp_path: Path) -> None:
    server = Caching()
    with caching(server) as url:
        first = run(url, output=tmp_path)
        assert (len(server.seen), server.hits) == (10, 0)  # of two variants
        assert not {"server-cache", "prompt-cache", "duplicate-frames"} & codes(first)
        manifest = json.loads((Path(first["run"]) / "manifest.json").read_text())
        again = run(url, "--nonce", manifest["seeds"]["nonce"], output=tmp_path)
        assert len(server.seen) == server.hits == 10
        other = run(url, output=tmp_path)
    assert (len(server.seen), server.hits, "server-cache" in codes(other)) == (20, 10, False)
    assert "server-cache" in codes(again)
    assert "vllm:mm_cache_hits_total: 10" in next(
        w["message"] for w in again["warnings"] if w["code"] == "server-cache"
    )
    assert json.loads((Path(again["run"]) / "manifest.json").read_text())["seeds"] == manifest["seeds"]
