"""openpi's protocol: our server for anybody's clients, our client for anybody's servers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any
from unittest.mock import DEFAULT, Mock

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, ConnectionClosedOK, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect as plain_connect
from websockets.sync.server import serve as plain_serve

from s2a_bench.errors import RequestFailed, ServerDied
from s2a_bench.inference import EngineConfig
from s2a_bench.plugins.policy_servers.websocket import server as websocket_server
from s2a_bench.plugins.policy_servers.websocket.codec import packb, unpackb
from s2a_bench.provenance import Provenance
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import budget
from s2a_bench.transport import Client, Handler, Server, open_client, open_server
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.risks import examine
from s2a_bench.transport.serving import Queued
from s2a_bench.types import Request
from tests.servers.policy_websocket import handled_by, policy_server, relative
from tests.transport.test_every_server import Gate
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
pytestmark = pytest.mark.filterwarnings("ignore:connect.. must be used as a context manager:DeprecationWarning")


@contextmanager
def serving(handler: Handler, address: str = "", limits: Limits | None = None, **options: Any) -> Iterator[Server]:
    wiring = wiring_of("websocket", address, **options)
    with served(replace(wiring, limits=limits or wiring.limits), handler) as (server, _):
        yield server


@contextmanager
def robot(address: str, path: str = "", **more: Any) -> Iterator[Any]:
    """A plain WebSocket client, greeted."""
    with plain_connect(address + path, compression=None, max_size=None, proxy=None, close_timeout=1, **more) as socket:
        yield socket, unpackb(socket.recv())


def get(address: str, path: str, **headers: str) -> tuple[int, str]:
    response = httpx.get(address.replace("ws:", "http:") + path, headers=headers, timeout=10)
    return response.status_code, response.text


# anybody's clients at our server


def openpi(address: str, **more: Any) -> Any:
    return pytest.importorskip("openpi_client.websocket_client_policy").WebsocketClientPolicy(address, **more)


def test_openpi_client_gets_actions_from_our_server() -> None:
    handler = RecordingHandler(list(CHUNK))
    queued = Queued.around(handler)
    queued.settings, queued.provenance = EngineConfig(name="echo", answer="actions", horizon=4), {"engine": "echo"}
    with serving(queued) as server:
        policy = openpi(server.address)
        metadata = policy.get_server_metadata()
        first, second = (
            policy.infer({"observation/image": np.zeros((8, 9, 3), np.uint8), "prompt": "go"}) for _ in "ab"
        )
        policy._ws.close()
    assert (metadata["server"], metadata["engine"], metadata["action_horizon"]) == ("s2a-bench", "echo", 4)
    assert metadata["provenance"] == {"engine": "echo"}
    assert set(first) == {"actions", "server_timing"}  # no marks for others
    assert first["actions"].dtype == np.float32
    np.testing.assert_array_equal(first["actions"], CHUNK)
    assert set(first["server_timing"]) == {"infer_ms"}
    assert set(second["server_timing"]) == {"infer_ms", "prev_total_ms"}
    assert handler.requests[0].prompt == "go"
    assert handler.requests[0].images[0].data.shape == (8, 9, 3)


def test_openpi_client_gets_an_error_as_text_and_the_connection_closes_with_1011() -> None:
    handler = RecordingHandler(list(CHUNK))
    handler.fail_at = 0
    with serving(handler) as server:
        policy = openpi(server.address)
        with pytest.raises(RuntimeError, match=r"^Error in inference server:\nthe engine has had enough$"):
            policy.infer({"prompt": "go"})
        with pytest.raises(ConnectionClosed) as closed:
            policy._ws.recv()
        assert closed.value.rcvd.code == 1011
        handler.fail_at = None
        assert len(openpi(server.address).infer({"prompt": "go"})["actions"]) == 4


def test_openpi_client_with_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOT_KEY", "open sesame")
    with serving(RecordingHandler(list(CHUNK)), api_key_env="ROBOT_KEY") as server:
        policy = openpi(server.address, api_key="open sesame")
        assert policy.infer({"prompt": "go"})["actions"].shape == (4, 3)
        policy._ws.close()
        for key in ("guess", None):
            with pytest.raises(InvalidStatus) as refused:
                openpi(server.address, api_key=key)
            assert refused.value.response.status_code == 401
        assert get(server.address, "/healthz") == (200, "OK\n")


def test_policy_websocket_client_gets_actions_from_our_server() -> None:
    peer = pytest.importorskip("policy_websocket")
    with serving(RecordingHandler(list(CHUNK))) as server:
        policy = peer.WebsocketClientPolicy(server.address)
        np.testing.assert_array_equal(policy.infer({"state": np.zeros(7), "prompt": "go"})["actions"], CHUNK)
        policy.close()


def test_a_stranger_asks_for_the_stream() -> None:
    with serving(RecordingHandler(list(CHUNK))) as server, robot(server.address, "/stream") as (socket, _):
        socket.send(packb({"prompt": "go"}))
        messages = [unpackb(socket.recv()) for _ in range(5)]
    assert [message["type"] for message in messages] == ["partial"] * 4 + ["final"]
    for index, message in enumerate(messages[:4]):
        np.testing.assert_array_equal(message["actions"], CHUNK[[index]])
        assert message["action_indices"].tolist() == [index]
    np.testing.assert_array_equal(messages[4]["actions"], CHUNK)
    assert "infer_ms" in messages[4]["server_timing"]


def test_health_and_pings_are_answered_while_a_request_runs() -> None:
    gate = Gate("websocket/openpi")
    with serving(gate) as server, robot(server.address) as (socket, _):
        socket.send(packb({"prompt": "go"}))
        until(lambda: gate.began)
        assert get(server.address, "/healthz") == (200, "OK\n")
        assert socket.ping().wait(20)
        gate.go.set()
        assert unpackb(socket.recv())["actions"].shape == (2, 2)


@pytest.mark.parametrize(
    ("piece", "message", "says", "code"),
    [
        (CHUNK[0], "an observation as text", "a binary message, not a text", 1003),
        (CHUNK[0], b"\xc1", "bytes that are not a message", 1011),
        ("a token", packb({"prompt": "go"}), "choose `answer` actions", 1011),
    ],
)
def test_a_request_without_an_answer_is_refused_in_a_line(piece: Any, message: Any, says: str, code: int) -> None:
    with serving(RecordingHandler([piece])) as server, robot(server.address) as (socket, _):
        socket.send(message)
        assert says in socket.recv(timeout=20)
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=20)
    assert closed.value.rcvd.code == code


def test_a_handshake_that_is_none_or_names_another_host_is_refused() -> None:
    headers = {"Host": "robot.example"}
    with serving(RecordingHandler(list(CHUNK)), allow_host="robot.example") as server:
        assert get(server.address, "/healthz", **headers) == (200, "OK\n")
    with serving(RecordingHandler(list(CHUNK))) as server:
        assert get(server.address, "/healthz") == (200, "OK\n")
        for path, more, status, says in (("/healthz", headers, 403, "--allow-host"), ("/", {}, 426, "WebSocket")):
            answer = get(server.address, path, **more)
            assert answer[0] == status
            assert says in answer[1]


def test_a_client_that_does_not_read_is_cut_off_and_the_next_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(websocket_server, "SEND_S", 0.2)
    handler = RecordingHandler(list(np.zeros((1000, 5000), np.float32)))
    with (
        serving(handler) as server,
        robot(server.address, "/stream", max_queue=1) as (slow, _),
        robot(server.address, "/stream") as (other, _),
    ):
        slow.send(packb({"prompt": "go"}))
        assert unpackb(slow.recv(timeout=20))["type"] == "partial"
        other.send(packb({"prompt": "go"}))
        assert [unpackb(other.recv(timeout=20))["type"] for _ in range(1001)][-1] == "final"
        with pytest.raises(ConnectionClosed):
            _ = [slow.recv(timeout=20) for _ in range(1001)]


@pytest.mark.parametrize("error", [None, OSError("no descriptors"), RuntimeError("no threads")])
def test_a_server_whose_accept_fails_says_so_and_accepts_again(
    error: Exception | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    in_vain = Mock(**{"serve_forever.side_effect": error})
    libraries = Mock(side_effect=[in_vain, DEFAULT], wraps=plain_serve)
    monkeypatch.setattr(websocket_server, "serve", libraries)
    with serving(RecordingHandler(list(CHUNK))) as server, robot(server.address) as (socket, _):
        socket.send(packb({"prompt": "go"}))
        assert unpackb(socket.recv(timeout=20))["actions"].shape == (4, 3)
    assert libraries.call_count == 2
    assert "no connection can be accepted" in caplog.text


def test_a_server_that_stops_sends_the_answer_under_way_and_says_that_it_goes() -> None:
    gate = Gate("websocket/openpi")
    server = open_server(wiring_of("websocket"), gate)
    serve = Thread(target=server.serve)
    serve.start()
    with robot(server.address) as (busy, _), robot(server.address) as (idle, _):
        busy.send(packb({"prompt": "go"}))
        until(lambda: gate.began)
        server.stop()
        gate.go.set()
        assert unpackb(busy.recv(timeout=20))["actions"].shape == (2, 2)
        for socket in (busy, idle):
            with pytest.raises(ConnectionClosedOK) as closed:
                socket.recv(timeout=20)
            assert closed.value.rcvd.code == 1001
    serve.join(30)
    assert not serve.is_alive()


def test_the_doctor_tells_of_compression_and_of_a_path_that_is_cut_when_idle() -> None:
    with handled_by(lambda _: None, {}, compression="deflate") as address:
        found = {finding.code: finding for finding in examine(address + "/v1/realtime/robot/openpi/")}
    assert found["compression"].level == "advice"
    assert "after 30 s of silence" in found["idle"].message
    assert "vllm-omni" in found["idle"].fix


# our client


def test_a_server_that_came_back_is_connected_to_again() -> None:
    handler = RecordingHandler(list(CHUNK))
    with serving(handler) as server:
        client = open_client(replace(wiring_of("websocket"), address=server.address))
        ask(client, Request("a", "go"))
    with serving(handler, server.address) as again:
        assert again.address == server.address
        _, trace = ask(client, Request("b", "go"))
        assert trace.facts["reconnects"] == 1
        client.close()


def test_an_address_where_nobody_is() -> None:
    with foreign("ws://127.0.0.1:9") as client, pytest.raises(ServerDied, match=r"nothing answers at ws://127.0.0.1:9"):
        ask(client, Request("a", "go"))


def test_a_foreign_server_takes_pixels_unless_its_template_says_otherwise(tmp_path: Path) -> None:
    (tmp_path / "files.toml").write_text('image = "{image:0|bytes}"\n')
    pixels = wiring_of("websocket", url="ws://a:1")
    files = wiring_of("websocket", url="ws://a:1", template=str(tmp_path / "files.toml"))
    assert (pixels.options.payload, files.options.payload) == ("raw", "jpeg")


# somebody else's servers


def foreign(address: str, name: str = "websocket/openpi", **options: Any) -> closing[Client]:
    return closing(open_client(wiring_of(name, url=address, **options)))


def test_a_server_of_ours_behind_a_url_says_who_answers_and_keeps_its_marks() -> None:
    queued = Queued.around(RecordingHandler(list(CHUNK)))
    queued.provenance = Provenance("echo", weights="none", tokens="emulated", profile="latencies 80 ms").to_dict()
    with serving(queued) as server, foreign(server.address) as client:
        _, trace = ask(client, Request("a", "go", (yuyv_frame(64, 48),)))
    assert {"network", "inference", "return"} <= budget(trace.chain()).stages_ns.keys()
    assert trace.provenance == queued.provenance


@pytest.mark.parametrize(
    ("greeting", "engine", "model"),
    [
        ({"provenance": {"engine": "pi0", "model": "m" * 10_000, "more": [1] * 100, b"x": "y"}}, "pi0", "m" * 200),
        ({"provenance": {"engine": 3, "model": None}}, "unknown", ""),
        ({"provenance": "echo"}, "unknown", ""),
    ],
)
def test_what_a_foreign_server_says_of_itself_is_bounded(greeting: Any, engine: str, model: str) -> None:
    with relative(lambda _: {"actions": CHUNK}, greeting) as (address, _), foreign(address) as client:
        _, trace = ask(client, Request("a", "go", (yuyv_frame(64, 48),)))
    assert trace.provenance == Provenance(engine, model).to_dict()


@pytest.mark.parametrize(
    ("timing", "inference_ns"),
    [
        ({"infer_ms": 1e-4}, 100),
        *((each, None) for each in ({"infer_ms": 1e9}, {"infer_ms": np.nan}, {"infer_ms": "5"}, [1])),
    ],
)
def test_a_foreign_server_describes_itself_and_its_time_is_split(timing: Any, inference_ns: int | None) -> None:
    answer = {"actions": CHUNK.astype(np.float64), "server_timing": timing}
    with (
        relative(lambda _: answer, {"model": "m" * 99, "secret": b"x"}) as (address, heard),
        foreign(address) as client,
    ):
        actions, trace = ask(client, Request("a", "go"))
        assert client.describe() == {"url": address, "template": "openpi", "model": "m" * 64}
    np.testing.assert_array_equal(np.stack([action.values for action in actions]), CHUNK)
    assert len(heard) == 2  # one connection, one observation
    stages = budget(trace.chain()).stages_ns
    assert "server" in stages
    assert stages.get("inference") == inference_ns
    assert not inference_ns or trace.facts["infer_ms"] == 1e-4


def test_what_comes_unasked_is_no_answer_to_the_next_request() -> None:
    def twice(socket: Any) -> None:
        for message in socket:
            number = unpackb(message)["state"][0]
            answer = Frame(Opcode.BINARY, packb({"actions": np.array([[number]])})).serialize(mask=False)
            socket.socket.sendall(answer * 2)

    with handled_by(twice, {}) as address, foreign(address, template="aloha") as client:
        for number in (1.0, 2.0, 3.0):
            (action,), _ = ask(client, Request("a", "go", (yuyv_frame(),), state=(number,) * 14))
            assert action.values.tolist() == [number]


def test_pings_are_answered_between_requests() -> None:
    answered = Event()

    def pinging(socket: Any) -> None:
        socket.recv()
        socket.send(packb({"actions": CHUNK}))
        if socket.ping().wait(20):
            answered.set()
        socket.recv()

    with handled_by(pinging, {}) as address, foreign(address) as client:
        ask(client, Request("a", "go"))
        assert answered.wait(20)


def test_a_foreign_stream_is_read_whether_or_not_its_last_frame_repeats_it() -> None:
    def streaming(socket: Any) -> None:
        socket.recv()
        for at in (0, 1):
            socket.send(packb({"type": "partial", "actions": CHUNK[at : at + 1]}))
        socket.send(packb({"type": "final", "actions": CHUNK, "server_timing": {"infer_ms": 3.0}}))
        socket.recv()

    with handled_by(streaming, {}) as address, foreign(address, "websocket/openpi-stream") as client:
        actions, trace = ask(client, Request("a", "go"))
    assert [action.index for action in actions] == [0, 1, 2, 3]
    np.testing.assert_array_equal(np.stack([action.values for action in actions]), CHUNK)
    assert "inference" not in budget(trace.chain()).stages_ns  # the first action came long before it was over


def test_our_client_gets_actions_from_policy_websocket() -> None:
    with policy_server() as address, foreign(address) as client:
        for _ in "ab":
            actions, trace = ask(client, Request("a", "go", (yuyv_frame(),), state=(0.5, 1.0)))
            assert [action.values.tolist() for action in actions] == [[0.5 * index, index] for index in range(10)]
            assert {"server", "inference"} <= set(budget(trace.chain()).stages_ns)
        assert trace.facts["prev_total_ms"] > 0
        with pytest.raises(RequestFailed, match="ValueError: no such task"):
            ask(client, Request("a", "fail", (yuyv_frame(),), state=(0.5,)))
        assert len(ask(client, Request("a", "go", (yuyv_frame(),), state=(0.5,)))[0]) == 10
        assert client.describe()["robot"] == "none"
