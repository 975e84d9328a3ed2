"""What servers of ours refuse: sizes, times, numbers and texts beyond their limits."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import httpx
import pytest

from s2a_bench.harness.serving import engine_handler
from s2a_bench.inference import EngineConfig, open_engine
from s2a_bench.testing.transport import served, wiring_of
from s2a_bench.transport.http.native import PARAMETERS_HEADER, PATHS
from s2a_bench.transport.limits import LIMITS, MIB, Limits

Urls = dict[str, str]
JSON = {"content-type": "application/json"}
HEAD = b"POST /v1/chat/completions HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"


@contextmanager
def serving(limits: Limits = LIMITS, variant: str = "as-deployed") -> Iterator[str]:
    """Serve echo for as long as the context lasts."""
    handler = engine_handler(open_engine(EngineConfig(name="echo")), limits=limits)
    with served(replace(wiring_of(f"http/{variant}"), limits=limits), handler) as (server, _):
        yield server.address


@pytest.fixture(scope="module")
def urls() -> Iterator[Urls]:
    """Our servers, by the variants that they answer."""
    with serving() as deployed, serving(variant="binary") as fast:
        yield {"as-deployed": deployed, "best-effort": fast, "binary": fast}


def post(url: str, variant: str, fields: str, prompt: str = '"go on"') -> httpx.Response:
    """Send a request of a variant, whose ``fields`` are JSON text."""
    if variant == "binary":
        headers = {PARAMETERS_HEADER: f'{{"prompt": {prompt}{fields and ", " + fields}}}'}
        return httpx.post(url + PATHS[variant], headers=headers)
    text = f'{{"messages": [{{"role": "user", "content": {prompt}}}]{fields and ", " + fields}}}'
    return httpx.post(url + PATHS[variant], content=text.encode(), headers=JSON)


variants = pytest.mark.parametrize("variant", list(PATHS))


@variants
@pytest.mark.parametrize("name", ["max_tokens", "seed"])
@pytest.mark.parametrize("value", ["-1", "1.5", "[]", "1e99", str(2**32), '"many"', "true", "{}"])
def test_a_number_that_is_none_is_refused(urls: Urls, variant: str, name: str, value: str) -> None:
    answer = post(urls[variant], variant, f'"{name}": {value}')
    assert answer.status_code == 400
    assert name in answer.json()["error"]["message"]


@variants
def test_the_least_and_the_most_are_taken(urls: Urls, variant: str) -> None:
    assert post(urls[variant], variant, '"max_tokens": 0').status_code == 400
    assert post(urls[variant], variant, f'"max_tokens": {LIMITS.answer_tokens + 1}').status_code == 400
    whole = post(urls[variant], variant, f'"max_tokens": 1, "seed": {2**32 - 1}')
    assert whole.json()["usage"]["completion_tokens"] == 1


@variants
@pytest.mark.parametrize("stream", ["true", "false"])
def test_half_a_surrogate_pair_is_refused_and_does_not_hold_the_engine(urls: Urls, variant: str, stream: str) -> None:
    for _ in range(2):
        answer = post(urls[variant], variant, f'"request_id": "\\ud800", "stream": {stream}')
        assert answer.status_code == 400
        assert post(urls[variant], variant, f'"stream": {stream}', prompt='"\\ud800"').status_code == 400
    assert post(urls[variant], variant, '"max_tokens": 2').status_code == 200


def test_a_raw_picture_of_too_many_pixels_is_refused(urls: Urls) -> None:
    headers = {PARAMETERS_HEADER: "{}", "content-type": "application/x-raw;width=-1;height=-3;encoding=bgr8"}
    answer = httpx.post(urls["binary"] + PATHS["binary"], content=b"abc" * 3, headers=headers)
    assert answer.status_code == 400


def connect(url: str) -> socket.socket:
    host, port = url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=20)


def reply(connection: socket.socket) -> tuple[int, str]:
    """Read until the server closes; return the status, 0 for none, and the rest."""
    data = b""
    with contextlib.suppress(ConnectionError):
        while piece := connection.recv(65536):
            data += piece
    return (int(data.split()[1]) if data else 0), data.decode()


class TestDoor:
    def test_a_body_that_does_not_say_is_counted(self) -> None:
        with serving(Limits(body_mib=1000 / MIB)) as url, connect(url) as connection:
            connection.sendall(HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + b"100\r\n" + bytes(256) + b"\r\n")
            with contextlib.suppress(ConnectionError):
                for _ in range(4):
                    connection.sendall(b"100\r\n" + bytes(256) + b"\r\n")
            assert reply(connection)[0] == 413

    def test_a_body_that_comes_after_the_answer_is_thrown_away(self) -> None:
        with serving(Limits(in_flight_mib=1)) as url:
            for _ in range(3):
                with connect(url) as connection:
                    connection.sendall(b"POST /nowhere HTTP/1.1\r\nHost: localhost\r\nContent-Length: 600000\r\n\r\n")
                    time.sleep(0.2)
                    with contextlib.suppress(ConnectionError):
                        connection.sendall(b" " * 600_000)
                    time.sleep(0.2)
                    connection.sendall(b"GET /health HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
                    status, body = reply(connection)
                    assert status == 404
                    assert body.endswith('{"status":"ok"}')


STUCK = """
import sys, time
from s2a_bench.harness import serving
from s2a_bench.types import Token

class Stuck:
    facts = {}
    def generate(self, request):
        time.sleep(3600)
        yield Token(0, "a")
    def describe(self): return {}
    def close(self): time.sleep(3600)

serving.open_engine = lambda config: Stuck()
sys.exit(serving.main())
"""


@pytest.mark.slow
@pytest.mark.parametrize("stream", [True, False])
def test_a_signal_ends_the_server_whatever_it_does(stream: bool) -> None:
    from s2a_bench.harness.serving import ServerJob

    job = ServerJob(wiring_of("http"), EngineConfig(name="echo")).to_json()
    process = subprocess.Popen(
        [sys.executable, "-c", STUCK], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    with process:
        try:
            assert process.stdin
            assert process.stdout
            process.stdin.write(job.encode() + b"\n")
            process.stdin.flush()
            url = json.loads(process.stdout.readline())["address"]
            data = json.dumps({"messages": [{"role": "user", "content": "a"}], "stream": stream}).encode()
            with connect(url) as connection:
                connection.sendall(HEAD + b"Content-Length: %d\r\n\r\n" % len(data) + data)
                time.sleep(0.5)
                os.kill(process.pid, signal.SIGTERM)
                assert process.wait(30) == 0
        finally:
            process.kill()
