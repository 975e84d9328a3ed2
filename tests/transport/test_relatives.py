"""Servers that speak openpi's protocol with paths, sessions, answers and errors of their own, and our client."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from PIL import Image
from websockets.sync.server import serve

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import budget
from s2a_bench.transport import TRANSPORTS, Choice, Client, open_client
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.risks import examine
from s2a_bench.transport.websocket import risks
from s2a_bench.transport.websocket.codec import packb, unpackb
from s2a_bench.types import Request
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
REQUEST = Request("a", "go", (yuyv_frame(64, 48, 1), yuyv_frame(64, 48, 2)), state=(0.5, 1.0))


@contextmanager
def relative(answer: Callable[[Any], Any], *, greets: bool = True, **packing: bool) -> Iterator[tuple[str, list[Any]]]:
    """A server that answers each message by a function: its address, and the paths and messages that came.

    An empty message has no answer.
    """
    heard: list[Any] = []

    def handle(socket: Any) -> None:
        heard.append(socket.request.path)
        if greets:
            socket.send(packb({"model": "pi0"}))
        for message in socket:
            heard.append(unpackb(message) if message else b"")
            if message:
                socket.send(packb(answer(heard[-1]), **packing))

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield "ws://{}:{}".format(*server.socket.getsockname()[:2]), heard
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def robot(address: str, template: str, name: str = "websocket") -> Iterator[Client]:
    client = open_client(wiring_of(name, url=address, template=template))
    try:
        yield client
    finally:
        client.close()


def asked(address: str, template: str, name: str = "websocket") -> np.ndarray[Any, Any]:
    with robot(address, template, name) as client:
        actions, trace = ask(client, REQUEST)
    assert "server" in budget(trace.chain()).stages_ns
    return np.stack([action.values for action in actions])


@pytest.mark.parametrize("answer", [CHUNK, CHUNK[np.newaxis], {"arm": CHUNK[:, :2], "gripper": CHUNK[:, 2:]}])
def test_vllm_omni_answers_with_an_array_or_a_map_of_them_after_a_reset(answer: Any) -> None:
    with relative(lambda message: {"status": "reset"} if "endpoint" in message else answer) as (address, heard):
        for _ in "ab":
            np.testing.assert_array_equal(asked(address, "vllm-omni"), CHUNK)
    path, reset, observation, *again = heard
    assert (path, reset) == ("/v1/realtime/robot/openpi", {"endpoint": "reset"})
    assert observation["observation/wrist_image"].shape == (48, 64, 3)
    assert again[2]["session_id"] != observation["session_id"]


def test_an_empty_message_keeps_a_connection_open_that_would_be_cut(tmp_path: Path) -> None:
    (tmp_path / "idle.toml").write_text('prompt = "{prompt}"\ns2a.idle_s = 1\n')
    with (
        relative(lambda _: {"actions": CHUNK}) as (address, heard),
        robot(address, str(tmp_path / "idle.toml")) as client,
    ):
        ask(client, Request("a", "go"))
        until(lambda: heard[-1] == b"")
        _, trace = ask(client, Request("b", "go"))
    assert "reconnects" not in trace.facts
    assert len([each for each in heard if each == "/"]) == 1


def test_sglang_answers_as_openpi_does_at_a_path_of_its_own() -> None:
    with relative(lambda _: {"actions": CHUNK, "server_timing": {"infer_ms": 1e-4}}) as (address, heard):
        np.testing.assert_array_equal(asked(address, "sglang"), CHUNK)
        np.testing.assert_array_equal(asked(address + "/v1/actions/realtime", "sglang"), CHUNK)
    assert [each for each in heard if isinstance(each, str)] == ["/openpi/policy", "/v1/actions/realtime"]


def test_starvla_has_an_envelope_in_both_directions() -> None:
    def answer(message: Any) -> Any:
        return {"status": "ok", "request_id": message["request_id"], "data": {"actions": CHUNK[np.newaxis]}}

    with relative(answer) as (address, heard):
        np.testing.assert_array_equal(asked(address, "starvla"), CHUNK)
    (example,) = heard[1]["payload"]["examples"]
    assert heard[1]["type"] == "infer"
    assert [picture.shape for picture in example["image"]] == [(48, 64, 3)] * 2
    assert (example["lang"], example["state"].tolist()) == ("go", [0.5, 1.0])


def test_vla_eval_is_greeted_and_has_texts_as_the_keys_of_an_array() -> None:
    def answer(message: Any) -> Any:
        return {**message, "payload": {"actions": CHUNK[0]} if message["type"] == "observation" else {}}

    with relative(answer, greets=False, text_keys=True) as (address, heard):
        np.testing.assert_array_equal(asked(address, "vla-eval"), CHUNK[:1])
    _, hello, observation = heard
    assert (hello["type"], hello["payload"]) == ("hello", {"protocol_version": 1})
    assert observation["payload"]["images"]["wrist"].shape == (48, 64, 3)
    assert observation["payload"]["task_description"] == "go"


@pytest.mark.parametrize("payload", ["png", "jpeg"])
def test_vla_evals_robots_send_maps_of_encoded_pictures(payload: str) -> None:
    """Its image_codec.py (allenai/vla-evaluation-harness 5ea6e514): read by the key, opened by Pillow."""

    def answer(message: Any) -> Any:
        return {**message, "payload": {"actions": CHUNK[0]} if message["type"] == "observation" else {}}

    with relative(answer, greets=False, text_keys=True) as (address, heard):
        client = open_client(wiring_of("websocket", url=address, template="vla-eval", payload=payload))
        _, trace = ask(client, REQUEST)
        client.close()
    for picture, frame in zip(heard[2]["payload"]["images"].values(), REQUEST.images, strict=True):
        assert (picture["__image__"], picture["format"], picture["shape"]) == (True, payload, [48, 64, 3])
        seen = Image.open(BytesIO(picture["data"]))
        assert (seen.format, seen.size) == (payload.upper(), (64, 48))
        assert payload == "jpeg" or np.array_equal(np.asarray(seen), yuyv_to_rgb(frame.data))
    assert [name for name, _ in trace.chain()].count("image_encode") == 2


def test_a_picture_is_a_map_for_vla_eval_alone() -> None:
    for template, payloads in (("vla-eval", ("raw", "png", "jpeg")), ("starvla", ("raw",))):
        assert one_pipeline("websocket", url="ws://a:1", template=template).capabilities.payloads == payloads


@pytest.mark.parametrize(
    ("template", "answer", "says"),
    [
        ("vllm-omni", {"type": "error", "message": "Internal inference error"}, "Internal inference error"),
        ("sglang", {"error": "no 'state'\nin it"}, "no 'state' in it"),
        ("starvla", {"status": "error", "error": {"message": "no examples"}}, "no examples"),
        ("openpi", {"type": "error", "payload": {"error": "step failed"}}, "step failed"),
        ("openpi", {"type": "error"}, "an error without words"),
        ("openpi", [1], "an answer without actions: list"),
        ("starvla", {"data": {"action": 1}}, "an answer without data.actions: action"),
        ("vllm-omni", {"arm": CHUNK, "hand": CHUNK[1:]}, r"of one length: there are arm \(4, 3\), hand \(3, 3\)"),
        ("vllm-omni", np.zeros((2, 4, 3)), r"actions: shape \(2, 4, 3\) .*"),
    ],
)
def test_an_error_in_a_binary_message_is_quoted(template: str, answer: Any, says: str) -> None:
    replies = [{"status": "reset"}] if template == "vllm-omni" else []
    with relative(lambda _: replies.pop() if replies else answer) as (address, _), robot(address, template) as client:
        with pytest.raises(RequestFailed, match=rf"{says}$") as failed:
            ask(client, REQUEST)
        assert str(failed.value).isprintable()


@pytest.mark.parametrize(
    "more", [{"error": 0.25}, {"error": ""}, {"error": None}, {"type": np.zeros(2), "error": CHUNK}]
)
@pytest.mark.parametrize("name", ["openpi", "openpi-stream"])
def test_what_is_called_an_error_and_is_none_is_not_read(name: str, more: Any) -> None:
    with relative(lambda _: {"actions": CHUNK, **more}) as (address, _):
        np.testing.assert_array_equal(asked(address, "openpi", f"websocket/{name}"), CHUNK)


def test_a_connection_whose_reset_fails_is_not_used() -> None:
    refused = {"type": "error", "message": "no session"}
    with relative(lambda _: refused) as (address, heard), robot(address, "vllm-omni") as client:
        for _ in "ab":
            with pytest.raises(RequestFailed, match=r"no session$"):
                client.describe()
    assert [each for each in heard if isinstance(each, dict)] == [{"endpoint": "reset"}] * 2


@pytest.mark.parametrize("template", ["vllm-omni", "sglang", "starvla", "vla-eval"])
def test_our_own_server_is_asked_as_always(template: str) -> None:
    handler = RecordingHandler(list(CHUNK))
    wiring = wiring_of("websocket", template=template, payload="raw")
    with served(wiring, handler) as (server, _):
        client = open_client(wiring_of("websocket", server.address, template=template, payload="raw"))
        actions, _ = ask(client, REQUEST)
        client.close()
    assert len(actions) == 4
    assert (handler.requests[0].prompt, len(handler.requests[0].images)) == ("go", 2)


def test_a_description_of_the_server_is_for_websocket_alone() -> None:
    transport = TRANSPORTS["zmq"]
    with pytest.raises(UsageError, match=r"`template` starvla: zmq does not read s2a\.answer; leave it out"):
        transport.require(Choice(transport.options(template="starvla"), cameras=2))


def test_the_doctor_tells_of_a_server_that_waits_for_its_clients_first_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(risks, "PATIENCE_S", 0.3)
    with relative(lambda _: None, greets=False) as (address, _):
        found = {finding.code: finding for finding in examine(address)}
    assert "every client in (and greets with: nothing)" in found["no-key"].message
    assert {"plain-text", "no-key", "any-page", "keepalive"} == set(found)
