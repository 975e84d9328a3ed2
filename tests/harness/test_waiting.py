"""`--wait-for-server`: a run waits for a server that is not ready yet, and for one that is started again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http import HTTPStatus
from pathlib import Path
from socket import socket
from threading import Thread
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import serve

from s2a_bench.clock import VirtualClock
from s2a_bench.errors import ServerDied, TransportError, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.experiments.latency.run import run_latency
from s2a_bench.harness import rounds
from s2a_bench.plugins.policy_servers.websocket.codec import packb
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from s2a_bench.testing.transport import RecordingHandler
from s2a_bench.types import Token
from tests.servers.sockets import Received, head, serving
from tests.servers.speakers import Cloud, LlamaServer, answering

LOADING = b'{"error":{"message":"Loading model","type":"unavailable_error","code":503}}'
"""Of every path, as llama-server has it: ggml-org/llama.cpp 00dd0816, tools/server/server-http.cpp."""


class Waiting(NullProgress):
    """Keeps what a run says while it waits, and calls ``acts`` then, by the number of the wait."""

    def __init__(self, **acts: Callable[[], object]) -> None:
        self.waits: list[str] = []
        self._acts = acts

    def stage(self, text: str) -> None:
        if text.startswith("waiting "):
            self.waits.append(text)
            self._acts.get(f"at_{len(self.waits)}", lambda: None)()


@pytest.fixture(autouse=True)
def _virtual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = VirtualClock()
    monkeypatch.setattr(rounds, "SystemClock", lambda: clock)
    monkeypatch.setattr(rounds, "now_ns", clock.now_ns)


def measured(output: Path, progress: Waiting, url: str, wait_s: float = 60.0, **more: Any) -> Any:
    small: dict[str, Any] = {"size": (64, 48), "requests": 3, "warmup": 1, "max_tokens": 3, "sample_resources_hz": 0}
    transport = {"ws": "websocket/openpi", "grpc": "grpc", "tcp": "zmq"}.get(url.partition(":")[0], "http/best-effort")
    config = LatencyConfig(url=url, transports=(transport,), wait_for_server=wait_s, **{**small, **more})
    return read_run(run_latency(config, output, progress))


def free_port() -> int:
    with socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def refused_then(reply: Callable[[Received], Any], times: int, status: str, seen: list[str]) -> Callable[..., Any]:
    """A server that refuses its first requests, whatever they are."""

    def handle(received: Received) -> Any:
        seen.append(received.path)
        return [head(status, "application/json"), LOADING] if len(seen) <= times else reply(received)

    return handle


def test_a_server_that_starts_late_is_waited_for_and_its_run_is_whole(tmp_path: Path) -> None:
    port = free_port()
    with ExitStack() as later:
        reply = answering(Cloud(), RecordingHandler(["go", "_to"]))
        progress = Waiting(at_2=lambda: later.enter_context(serving(reply, port)))
        run = measured(tmp_path, progress, f"http://127.0.0.1:{port}", options={"http": {"dialect": "openai"}})
    assert (run.samples["error"] == "").tolist() == [True] * 4
    assert run.samples["warmup"].sum() == 1
    assert len(progress.waits) == 2
    assert f"http/best-effort: nothing answers at http://127.0.0.1:{port}" in progress.waits[0]


def test_a_server_that_loads_its_model_is_waited_for_and_then_recognised(tmp_path: Path) -> None:
    seen: list[str] = []
    chat = answering(LlamaServer(), RecordingHandler(["go"]))

    def reply(received: Received) -> Any:
        if received.path == "/v1/models":
            return [head(kind="application/json") + b'{"data":[{"id":"m","owned_by":"llamacpp"}]}']
        return chat(received)

    progress = Waiting()
    with serving(refused_then(reply, 5, "503 Service Unavailable", seen)) as url:
        run = measured(tmp_path, progress, url)
    assert (run.samples["error"] == "").all()
    assert run.manifest["asked"]["http/best-effort"]["dialect"] == "llama-server"
    assert "answered 503: Loading model" in progress.waits[0]


def test_a_policy_server_that_refuses_handshakes_is_waited_for(tmp_path: Path) -> None:
    handshakes = []

    def gate(connection: Any, _request: Any) -> Any:
        handshakes.append(1)
        return connection.respond(HTTPStatus.BAD_GATEWAY, "starting\n") if len(handshakes) <= 3 else None

    def policy(link: Any) -> None:  # as openpi's: Physical-Intelligence/openpi 04a8d0c9
        link.send(packb({}))
        for _ in link:
            link.send(packb({"actions": np.zeros((4, 7), np.float32), "server_timing": {"infer_ms": 0.1}}))

    progress = Waiting()
    with serve(policy, "127.0.0.1", 0, process_request=gate, max_size=None) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        run = measured(tmp_path, progress, f"ws://127.0.0.1:{server.socket.getsockname()[1]}")
        server.shutdown()
        thread.join()
    assert (run.samples["error"] == "").tolist() == [True] * 4
    assert len(progress.waits) == 3


def test_the_last_error_says_how_long_was_waited(tmp_path: Path) -> None:
    url, progress = f"http://127.0.0.1:{free_port()}", Waiting()
    with pytest.raises(ServerDied, match=f"nothing answers at {url}.*; waited 2.5 s for it"):
        measured(tmp_path, progress, url, wait_s=2)
    assert len(progress.waits) == 5
    with pytest.raises(ServerDied, match="nothing answers at") as at_once:
        measured(tmp_path, progress, url, wait_s=0)
    assert "waited" not in str(at_once.value)


def test_a_server_that_refuses_the_key_is_there_and_not_waited_for(tmp_path: Path) -> None:
    seen: list[str] = []
    with serving(refused_then(lambda _: [], 10**6, "401 Unauthorized", seen)) as url:
        progress = Waiting()
        with pytest.raises(TransportError, match=r"failed 5 times in a row, at last with .* answered 401"):
            measured(tmp_path, progress, url, requests=60, options={"http": {"dialect": "openai"}})
    assert not [wait for wait in progress.waits if "0.5 s" in wait]


def test_waiting_needs_a_server_that_somebody_else_runs() -> None:
    with pytest.raises(UsageError, match="`wait_for_server` is about a server that runs already"):
        LatencyConfig(transports=("loopback",), wait_for_server=1.0).check()


def restarting(port: int, after: int) -> tuple[Callable[[], object], ExitStack]:
    """A server that ends with an answer, and what starts it again."""
    running, answers = ExitStack(), []

    def reply(received: Received) -> Iterator[bytes]:
        answers.append(received.method)
        if answers.count("POST") == after:
            running.close()
        yield head(kind=Cloud.kind) + Cloud().token(Token(0, "go")) + Cloud().closing([Token(0, "go")])

    return lambda: running.enter_context(serving(reply, port)), running


@pytest.mark.parametrize(("wait_s", "back"), [(0.0, "at_3"), (60.0, "at_9")])
def test_a_server_that_is_started_again_costs_samples_and_not_the_run(tmp_path: Path, wait_s: float, back: str) -> None:
    port = free_port()
    start, running = restarting(port, after=4)
    with running:
        start()
        url, options = f"http://127.0.0.1:{port}", {"http": {"dialect": "openai"}}
        run = measured(tmp_path, Waiting(**{back: start}), url, wait_s, requests=20, options=options)
    failed = run.samples["error"] != ""
    assert failed.sum() == int(back[3:]) + 1  # after the first failure it goes on at once
    assert set(run.samples["error"][failed].str.partition(":")[0]) == {"ServerDied"}
    assert not failed.iloc[-1]


def test_a_server_that_stays_away_ends_the_run_after_five_failures(tmp_path: Path) -> None:
    port = free_port()
    start, running = restarting(port, after=4)
    progress = Waiting()
    url, options = f"http://127.0.0.1:{port}", {"http": {"dialect": "openai"}}
    with running:
        start()
        with pytest.raises(TransportError, match="failed 5 times in a row, at last with ServerDied"):
            measured(tmp_path, progress, url, 0, requests=20, options=options)
    assert progress.waits == [f"waiting {seconds} s for the server of http/best-effort" for seconds in (1, 2, 4)]
