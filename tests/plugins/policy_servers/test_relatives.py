"""Servers that speak openpi's protocol with paths, sessions, answers and errors of their own, and our client."""

from __future__ import annotations

import json
from contextlib import closing
from http import HTTPStatus
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.plugins.policy_servers.observation import template_of
from s2a_bench.testing.transport import RecordingHandler, ask, served, wiring_of, yuyv_frame
from s2a_bench.trace import budget
from s2a_bench.transport import Client, open_client
from s2a_bench.transport.pipeline import one_pipeline
from s2a_bench.transport.risks import examine
from s2a_bench.types import Request
from tests.servers.policy_websocket import handled_by, relative
from tests.waiting import until

CHUNK = np.arange(12, dtype=np.float32).reshape(4, 3) / 8
REQUEST = Request("a", "go", (yuyv_frame(64, 48, 1), yuyv_frame(64, 48, 2)), state=(0.5, 1.0))


CAMERAS = {
    "sglang": ["base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"],
    "sglang-libero": ["image", "image2", "empty_camera_0"],
}
"""What a greeting of SGLang lists as ``input.image_keys`` for lerobot/pi05_base and lerobot/pi05_libero_base."""


def sglang(cameras: str = "sglang") -> dict[str, Any]:
    """The greeting of SGLang (sgl-project/sglang 0350f48f, action/protocol.py: action_metadata)."""
    return {
        "object": "action.metadata",
        "model": "policy",
        "policy_family": "pi05",
        "input": {"image_keys": CAMERAS[cameras], "image_size": [224, 224], "state_dim": 32},
        "output": {"action_type": "continuous", "action_horizon": 4, "action_dim": 3, "dtype": "float32"},
    }


def envelope(values: Any) -> dict[str, Any]:
    """SGLang's answer on /v1/actions (the same file: action_generation_response)."""
    action = {"type": "continuous", "dtype": "float32", "shape": [4, 3], "values": values}
    entry = {"index": 0, "input_index": 0, "candidate_index": 0, "action": action}
    return {"id": "act_1", "object": "action.generation", "data": [entry], "usage": {"batch_size": 1}}


def robot(address: str, template: str, payload: str = "raw") -> closing[Client]:
    return closing(open_client(wiring_of("websocket", url=address, template=template, payload=payload)))


def asked(address: str, template: str, cameras: int = 2, state: int = 2) -> np.ndarray[Any, Any]:
    frames = tuple(yuyv_frame(64, 48, index) for index in range(cameras))
    with robot(address, template) as client:
        actions, trace = ask(client, Request("a", "go", frames, state=tuple(np.arange(state) / 8)))
    assert "server" in budget(trace.chain()).stages_ns
    return np.stack([action.values for action in actions])


PICTURE, TWICE = (48, 64, 3), (1, 2, 48, 64, 3)
READ: dict[tuple[str, int, int], tuple[dict[str, Any], Any]] = {
    ("pi0", 3, 32): (  # 26f24af7, models/pi0/processor_pi0.py; deploy/pi0.yaml: image_feature_keys
        {**dict.fromkeys([f"observation.images.{key}" for key in CAMERAS["sglang"]], PICTURE), "state": (32,)},
        CHUNK,
    ),
    ("dreamzero", 3, 8): (  # b0de493a, models/dreamzero/transform/roboarena.py; the state as in droid.py beside it
        {
            "observation/exterior_image_0_left": PICTURE,
            "observation/exterior_image_1_left": PICTURE,
            "observation/wrist_image_left": PICTURE,
            "observation/joint_position": (7,),
            "observation/gripper_position": (1,),
        },
        CHUNK[np.newaxis],
    ),
    ("gr00t", 2, 17): (  # 0739042f, models/gr00t/pipeline_gr00t.py: _normalize_observation; shapes as in its tests
        {
            "video": {"exterior_image_1_left": TWICE, "wrist_image_left": TWICE},
            "state": {"eef_9d": (1, 1, 9), "gripper_position": (1, 1, 1), "joint_position": (1, 1, 7)},
        },
        {"eef_9d": CHUNK[np.newaxis, :, :2], "gripper_position": CHUNK[np.newaxis, :, 2:]},
    ),
    ("openvla", 1, 0): ({"image": PICTURE}, CHUNK),  # be0ce8e7, models/openvla/robot_adapter.py: _IMAGE_KEYS
}
"""Policy of vLLM-Omni, pictures and numbers of the state -> the shapes of all that it reads, and an answer."""


def shapes(value: Any) -> Any:
    return {key: shapes(each) for key, each in value.items()} if isinstance(value, dict) else value.shape


@pytest.mark.parametrize(("policy", "cameras", "state"), READ)
def test_vllm_omni_is_asked_by_the_keys_that_its_policy_reads_after_a_reset(
    policy: str, cameras: int, state: int
) -> None:
    read, answer = READ[policy, cameras, state]
    ready = "reset successful" if policy == "pi0" else {"status": "reset successful"}  # before 0.30, and since
    with relative(lambda message: ready if "endpoint" in message else answer) as (address, heard):
        for _ in "ab":
            np.testing.assert_array_equal(asked(address, f"vllm-omni-{policy}", cameras, state), CHUNK)
        if policy == "pi0":  # which would take zeros for it
            with pytest.raises(RequestFailed, match=r"vllm-omni-pi0: state wants the state's numbers \(all\)"):
                asked(address, "vllm-omni-pi0", 1, 0)
    path, reset, observation, _, _, again = heard[:6]
    assert (path, reset) == ("/v1/realtime/robot/openpi", {"endpoint": "reset"})
    assert observation.pop("session_id") != again["session_id"]
    assert observation.pop("prompt") == "go"
    assert shapes(observation) == read


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


@pytest.mark.parametrize(
    ("template", "path", "greeted"),
    [
        ("sglang", "/openpi/policy", "sglang"),
        ("sglang", "/openpi/policy", "sglang-libero"),
        ("sglang-libero", "/openpi/policy", "sglang-libero"),
        ("sglang-realtime", "/v1/actions/realtime", "sglang"),
    ],
)
@pytest.mark.parametrize("described", [True, False])
def test_sglang_is_asked_by_the_keys_that_its_greeting_lists_in_its_order(
    template: str, path: str, greeted: str, described: bool
) -> None:
    answer = envelope(CHUNK) if template == "sglang-realtime" else {"actions": CHUNK}
    said = {**answer, "server_timing": {"infer_ms": 1e-4}}
    with relative(lambda _: said, sglang(greeted)) as (address, heard), robot(address, template) as client:
        if described:
            client.describe()
        (actions, first), (_, again) = (ask(client, REQUEST) for _ in "ab")
    np.testing.assert_array_equal([action.values for action in actions], CHUNK)
    assert "server" in budget(first.chain()).stages_ns
    assert ("connect" in dict(first.marks), "connect" in dict(again.marks)) == (not described, False)
    assert "reconnects" not in first.facts | again.facts
    asked_at, *observations = heard
    assert asked_at == path
    for observation in observations:
        assert observation.pop("task") == "go"
        assert observation.pop("observation.state").tolist() == [0.5, 1.0]
        pictures = {
            f"observation.images.{key}": frame for key, frame in zip(CAMERAS[greeted], REQUEST.images, strict=False)
        }
        assert observation.keys() == pictures.keys()
        for key, frame in pictures.items():
            np.testing.assert_array_equal(observation[key], yuyv_to_rgb(frame.data))


@pytest.mark.parametrize("key", ["observation.images.image2", "image2", "observation.image2"])
def test_a_picture_that_the_server_does_not_list_is_an_error(tmp_path: Path, key: str) -> None:
    content = {key: "{image:1}", "image": "{image:0}", "prompt": "{prompt}", "state": "{state}"}
    (tmp_path / "mine.json").write_text(json.dumps(content))
    with (
        relative(lambda _: {"actions": CHUNK}, sglang("sglang-libero")) as (address, heard),
        robot(address, str(tmp_path / "mine.json")) as client,
    ):
        client.describe()
        if key != "observation.image2":
            ask(client, REQUEST)
            return
        says = f"mine.json: the server ignores '{key}', it reads 'image', 'image2', 'empty_camera_0'; "
        for _ in "ab":
            with pytest.raises(UsageError, match=says):
                ask(client, REQUEST)
        assert not [each for each in heard if isinstance(each, dict)]


@pytest.mark.parametrize(
    ("greeting", "says"),
    [
        ({"model": "pi0"}, "its greeting lists no pictures; take a template that names them"),
        ({"input": {"image_keys": ["image"]}}, r"the server reads 1 pictures \(image\), not 2; see `cameras`"),
    ],
)
def test_pictures_without_a_name_from_the_greeting_are_not_sent(greeting: Any, says: str) -> None:
    with (
        relative(lambda _: {"actions": CHUNK}, greeting) as (address, heard),
        pytest.raises(RequestFailed, match=says),
    ):
        asked(address, "sglang")
    assert heard == ["/openpi/policy"]
    with relative(lambda _: {"actions": CHUNK}, {"input": {"image_keys": ["image"]}}) as (address, _):
        np.testing.assert_array_equal(asked(address, "sglang", 1, 2), CHUNK)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('"images.*" = "{images}"\nprompt = "{prompt}"\n', "zmq has no greeting that names pictures; name them"),
        ('p = "{prompt}"\ns2a.answer = "actions"\n', r"zmq does not read s2a\.answer; leave it out"),
    ],
)
def test_what_tells_of_the_server_is_for_websocket_alone(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(UsageError, match=says):
        template_of(str(tmp_path / "mine.toml")).check_server("zmq", ())


@pytest.mark.parametrize(
    ("status", "advice"),
    [
        (HTTPStatus.UNAUTHORIZED, "; see `api_key_env`"),
        (HTTPStatus.FORBIDDEN, "; refused: a wrong path or a key; see `url` and `api_key_env`"),  # FastAPI's for a path
    ],
)
def test_a_handshake_that_is_refused_is_told_with_the_way_out(status: HTTPStatus, advice: str) -> None:
    def gate(connection: Any, _request: Any) -> Any:
        return connection.respond(status, "no\n")

    with handled_by(lambda _: None, process_request=gate) as address:
        with pytest.raises(RequestFailed, match=rf"answered {status.value}: no{advice}$"):
            asked(address, "openpi")
        (found,) = examine(address)
    assert (found.code, found.level) == ("server", "state")
    assert advice in found.message


def test_starvla_has_an_envelope_in_both_directions() -> None:
    def answer(message: Any) -> Any:
        return {"status": "ok", "request_id": message["request_id"], "data": {"actions": CHUNK[np.newaxis]}}

    with relative(answer) as (address, heard):
        np.testing.assert_array_equal(asked(address, "starvla"), CHUNK)
    (example,) = heard[1]["payload"]["examples"]
    assert heard[1]["type"] == "infer"
    assert [picture.shape for picture in example["image"]] == [(48, 64, 3)] * 2
    assert (example["lang"], example["state"].tolist()) == ("go", [0.0, 0.125])


@pytest.mark.parametrize("payload", ["raw", "png", "jpeg"])
def test_vla_eval_is_greeted_and_has_texts_as_the_keys_of_an_array_and_maps_of_encoded_pictures(payload: str) -> None:
    """Its image_codec.py (allenai/vla-evaluation-harness 5ea6e514): read by the key, opened by Pillow."""

    def answer(message: Any) -> Any:
        return {**message, "payload": {"actions": CHUNK[0]} if message["type"] == "observation" else {}}

    with relative(answer, None, text_keys=True) as (address, heard), robot(address, "vla-eval", payload) as client:
        (action,), trace = ask(client, REQUEST)
    np.testing.assert_array_equal(action.values, CHUNK[0])
    _, hello, observation = heard
    assert (hello["type"], hello["payload"]) == ("hello", {"protocol_version": 1})
    assert observation["payload"]["task_description"] == "go"
    pictures = observation["payload"]["images"].values()
    if payload == "raw":
        assert [picture.shape for picture in pictures] == [PICTURE] * 2
        return
    for picture, frame in zip(pictures, REQUEST.images, strict=True):
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
        ("vllm-omni-pi0", {"type": "error", "message": "Internal inference error"}, "Internal inference error"),
        ("sglang", {"error": "no 'state'\nin it"}, "no 'state' in it"),
        ("starvla", {"status": "error", "error": {"message": "no examples"}}, "no examples"),
        ("openpi", {"type": "error", "payload": {"error": "step failed"}}, "step failed"),
        ("openpi", {"type": "error"}, "an error without words"),
        ("openpi", [1], "an answer without actions: list"),
        ("openpi", {"nothing": 1}, "an answer without actions: nothing"),
        ("openpi", "Traceback (most recent call last):\n  File x\nKeyError: 'state'\n", "File x KeyError: 'state'"),
        ("openpi", {"actions": np.full((2, 2), np.nan)}, "actions: not finite numbers"),
        ("openpi", {"actions": "up"}, "actions: .*"),
        ("openpi", b"\xc1", "bytes that are not a message.*"),
        ("openpi", {"actions": CHUNK, "more": bytes(20 << 20)}, r"sent more than \d+ bytes.*"),
        ("starvla", {"data": {"action": 1}}, "an answer without data.actions: action"),
        ("sglang-realtime", {"data": []}, "an answer without data.0.action.values: list"),
        ("sglang-realtime", {"data": {"0": 1}}, "an answer without data.0.action.values: int"),
        ("vllm-omni-pi0", {"arm": CHUNK, "hand": CHUNK[1:]}, r"of one length: there are arm \(4, 3\), hand \(3, 3\)"),
        ("vllm-omni-pi0", np.zeros((2, 4, 3)), r"actions: shape \(2, 4, 3\) .*"),
    ],
)
def test_an_answer_that_is_none_is_one_line_and_the_next_request_may_succeed(
    template: str, answer: Any, says: str
) -> None:
    resets = template == "vllm-omni-pi0"
    answers = [*([{"status": "reset"}] if resets else []), answer, {"actions": CHUNK}]
    greeting = sglang() if template.startswith("sglang") else {}
    with relative(lambda _: answers.pop(0), greeting) as (address, _), robot(address, template) as client:
        with pytest.raises(RequestFailed, match=rf"{says}$") as failed:
            ask(client, REQUEST)
        assert str(failed.value).isprintable()
        if template == "openpi":
            assert len(ask(client, REQUEST)[0]) == 4


@pytest.mark.parametrize("more", [{"error": 0.25}, {"error": ""}, {"type": np.zeros(2), "error": CHUNK}])
def test_what_is_called_an_error_and_is_none_is_not_read(more: Any) -> None:
    with relative(lambda _: {"actions": CHUNK, **more}) as (address, _):
        np.testing.assert_array_equal(asked(address, "openpi"), CHUNK)


@pytest.mark.parametrize(
    ("refused", "says"),
    [
        ({"type": "error", "message": "no session"}, "no session"),
        ("Traceback (most recent call last):\n  ...\nKeyError: 'x'\n", "KeyError: 'x'"),
    ],
)
def test_a_connection_whose_reset_fails_is_not_used(refused: Any, says: str) -> None:
    with relative(lambda _: refused) as (address, heard), robot(address, "vllm-omni-pi0") as client:
        for _ in "ab":
            with pytest.raises(RequestFailed, match=rf"{says}$"):
                client.describe()
    assert [each for each in heard if isinstance(each, dict)] == [{"endpoint": "reset"}] * 2


@pytest.mark.parametrize("template", ["vllm-omni-pi0", "sglang", "starvla", "vla-eval"])
def test_our_own_server_is_asked_as_always(template: str) -> None:
    handler = RecordingHandler(list(CHUNK))
    wiring = wiring_of("websocket", template=template, payload="raw")
    with served(wiring, handler) as (server, _):
        client = open_client(wiring_of("websocket", server.address, template=template, payload="raw"))
        actions, _ = ask(client, REQUEST)
        client.close()
    assert len(actions) == 4
    assert (handler.requests[0].prompt, len(handler.requests[0].images)) == ("go", 2)
