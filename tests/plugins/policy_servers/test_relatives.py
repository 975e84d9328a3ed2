"""Servers that speak openpi's protocol with paths, sessions, answers and errors of their own, and our client."""

from __future__ import annotations

from contextlib import AbstractContextManager, closing
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
from s2a_bench.transport import TRANSPORTS, Choice, Client, open_client
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


def sglang(*, cameras: str = "sglang") -> dict[str, Any]:
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


def asked(address: str, template: str, request: Request = REQUEST) -> np.ndarray[Any, Any]:
    with robot(address, template) as client:
        actions, trace = ask(client, request)
    assert "server" in budget(trace.chain()).stages_ns
    return np.stack([action.values for action in actions])


def asked_with(address: str, template: str, cameras: int, state: int) -> np.ndarray[Any, Any]:
    frames = tuple(yuyv_frame(64, 48, index) for index in range(cameras))
    return asked(address, template, request=Request("a", "go", frames, state=tuple(np.arange(state) / 8)))


PICTURE, TWICE = (48, 64, 3), (1, 2, 48, 64, 3)
READ = {
    "pi0": (
        # 26f24af7, models/pi0/processor_pi0.py; deploy/pi0.yaml: image_feature_keys
        {
            "observation.images.base_0_rgb": PICTURE,
            "observation.images.left_wrist_0_rgb": PICTURE,
            "observation.images.right_wrist_0_rgb": PICTURE,
            "state": (32,),
        },
        CHUNK,
    ),
    "dreamzero": (
        # b0de493a, models/dreamzero/transform/roboarena.py; the state as in droid.py beside it
        {
            "observation/exterior_image_0_left": PICTURE,
            "observation/exterior_image_1_left": PICTURE,
            "observation/wrist_image_left": PICTURE,
            "observation/joint_position": (7,),
            "observation/gripper_position": (1,),
        },
        CHUNK[np.newaxis],
    ),
    "gr00t": (
        # 0739042f, models/gr00t/pipeline_gr00t.py: _normalize_observation; shapes as its tests have them
        {
            "video": {"exterior_image_1_left": TWICE, "wrist_image_left": TWICE},
            "state": {"eef_9d": (1, 1, 9), "gripper_position": (1, 1, 1), "joint_position": (1, 1, 7)},
        },
        {"eef_9d": CHUNK[np.newaxis, :, :2], "gripper_position": CHUNK[np.newaxis, :, 2:]},
    ),
    "openvla": ({"image": PICTURE}, CHUNK),  # be0ce8e7, models/openvla/robot_adapter.py: _IMAGE_KEYS
}
"""Policy of vLLM-Omni (vllm-project/vllm-omni) -> the shapes of all that it reads, and an answer."""


def shapes(value: Any) -> Any:
    return {key: shapes(each) for key, each in value.items()} if isinstance(value, dict) else value.shape


@pytest.mark.parametrize(
    ("policy", "cameras", "state"), [("pi0", 3, 32), ("dreamzero", 3, 8), ("gr00t", 2, 17), ("openvla", 1, 0)]
)
def test_vllm_omni_is_asked_by_the_keys_that_its_policy_reads_after_a_reset(
    policy: str, cameras: int, state: int
) -> None:
    read, answer = READ[policy]
    ready = "reset successful" if policy == "pi0" else {"status": "reset successful"}  # before 0.30, and since
    with relative(lambda message: ready if "endpoint" in message else answer) as (address, heard):
        for _ in "ab":
            np.testing.assert_array_equal(asked_with(address, f"vllm-omni-{policy}", cameras, state), CHUNK)
        path, reset, observation, *again = heard
        if policy == "pi0":  # which would take zeros for it
            with pytest.raises(RequestFailed, match=r"vllm-omni-pi0: state wants the state's numbers \(all\)"):
                asked_with(address, "vllm-omni-pi0", 1, 0)
    assert (path, reset) == ("/v1/realtime/robot/openpi", {"endpoint": "reset"})
    session = observation.pop("session_id")
    assert again[2]["session_id"] != session
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


@pytest.mark.parametrize("template", ["sglang", "sglang-libero", "sglang-realtime"])
def test_sglang_is_asked_by_the_keys_that_it_reads(template: str) -> None:
    keys = CAMERAS["sglang-libero" if template == "sglang-libero" else "sglang"]
    said = {"actions": CHUNK, "server_timing": {"infer_ms": 1e-4}}
    answer = {**envelope(CHUNK), "server_timing": {"infer_ms": 1e-4}} if template == "sglang-realtime" else said
    greeting = sglang(cameras="sglang-libero" if template == "sglang-libero" else "sglang")
    with relative(lambda _: answer, greeting) as (address, heard):
        np.testing.assert_array_equal(asked(address, template), CHUNK)
    path, observation = heard
    assert path == ("/v1/actions/realtime" if template == "sglang-realtime" else "/openpi/policy")
    assert observation.pop("task") == "go"
    images = {f"observation.images.{key}": PICTURE for key in keys[:2]}
    assert shapes(observation) == {**images, "observation.state": (2,)}


@pytest.mark.parametrize(
    ("key", "ignored"),
    [
        ('"observation.images.image2"', ""),
        ("image2", ""),
        ("observation.image2", "observation.image2"),
    ],
)
def test_a_picture_that_the_server_does_not_list_is_an_error(tmp_path: Path, key: str, ignored: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'{key} = "{{image:1}}"\nimage = "{{image:0}}"\nprompt = "{{prompt}}"\nstate = "{{state}}"\n')
    with (
        relative(lambda _: {"actions": CHUNK}, sglang(cameras="sglang-libero")) as (address, heard),
        robot(address, str(file)) as client,
    ):
        client.describe()
        if not ignored:
            ask(client, REQUEST)
            return
        says = f"mine.toml: the server ignores '{ignored}', it reads 'image', 'image2', 'empty_camera_0'; "
        for _ in "ab":
            with pytest.raises(UsageError, match=says):
                ask(client, REQUEST)
        assert not [each for each in heard if isinstance(each, dict)]


@pytest.mark.parametrize("described", [True, False])
def test_pictures_take_the_names_that_the_greeting_lists_in_its_order(*, described: bool) -> None:
    with (
        relative(lambda _: {"actions": CHUNK}, sglang(cameras="sglang-libero")) as (address, heard),
        robot(address, "sglang") as client,
    ):
        if described:
            client.describe()
        _, first = ask(client, REQUEST)
        _, again = ask(client, REQUEST)
    path, *observations = heard
    assert path == "/openpi/policy"
    for observation in observations:
        assert {key for key in observation if "image" in key} == {
            "observation.images.image",
            "observation.images.image2",
        }
        assert observation["observation.images.image"].mean() != observation["observation.images.image2"].mean()
    assert ("connect" in dict(first.marks), "connect" in dict(again.marks)) == (not described, False)
    assert "reconnects" not in first.facts | again.facts


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


def test_a_transport_without_a_greeting_refuses_a_template_that_needs_one(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('"images.*" = "{images}"\nprompt = "{prompt}"\n')
    with pytest.raises(UsageError, match="zmq has no greeting that names pictures; name them"):
        template_of(str(tmp_path / "mine.toml")).check_server("zmq", ())


def test_a_camera_that_the_request_lacks_is_not_looked_for_in_the_servers_list() -> None:
    greeting = {"input": {"image_keys": ["base_0_rgb"]}}
    with relative(lambda _: {"actions": CHUNK}, greeting) as (address, _):
        np.testing.assert_array_equal(asked_with(address, "sglang", 1, 2), CHUNK)


def gated(statuses: dict[str, HTTPStatus], others: HTTPStatus = HTTPStatus.FORBIDDEN) -> AbstractContextManager[str]:
    """Let clients in at a path of status OK; others have 403, as of FastAPI, of which SGLang's and vLLM-Omni's are."""

    def gate(connection: Any, request: Any) -> Any:
        status = statuses.get(request.path, others)
        return None if status == HTTPStatus.OK else connection.respond(status, "no\n")

    return handled_by(lambda socket: socket.recv(), {}, process_request=gate)


def test_a_path_that_fastapi_refuses_is_not_taken_for_a_key() -> None:
    with gated({"/openpi/policy": HTTPStatus.OK}) as address:
        with pytest.raises(RequestFailed, match=r"403.*refused: a wrong path or a key; see `url` and `api_key_env`"):
            asked(address, "openpi")
        (found,) = examine(address)
    assert (found.code, found.level) == ("server", "state")
    assert "refused: a wrong path or a key" in found.message


def test_starvla_has_an_envelope_in_both_directions() -> None:
    def answer(message: Any) -> Any:
        return {"status": "ok", "request_id": message["request_id"], "data": {"actions": CHUNK[np.newaxis]}}

    with relative(answer) as (address, heard):
        np.testing.assert_array_equal(asked(address, "starvla"), CHUNK)
    (example,) = heard[1]["payload"]["examples"]
    assert heard[1]["type"] == "infer"
    assert [picture.shape for picture in example["image"]] == [(48, 64, 3)] * 2
    assert (example["lang"], example["state"].tolist()) == ("go", [0.5, 1.0])


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
        ("starvla", {"data": {"action": 1}}, "an answer without data.actions: action"),
        ("sglang-realtime", {"data": []}, "an answer without data.0.action.values: list"),
        ("sglang-realtime", {"data": {"0": 1}}, "an answer without data.0.action.values: int"),
        ("vllm-omni-pi0", {"arm": CHUNK, "hand": CHUNK[1:]}, r"of one length: there are arm \(4, 3\), hand \(3, 3\)"),
        ("vllm-omni-pi0", np.zeros((2, 4, 3)), r"actions: shape \(2, 4, 3\) .*"),
    ],
)
def test_an_error_in_a_binary_message_is_quoted(template: str, answer: Any, says: str) -> None:
    replies = [{"status": "reset"}] if template == "vllm-omni-pi0" else []
    greeting = sglang() if template.startswith("sglang") else {}
    with (
        relative(lambda _: replies.pop() if replies else answer, greeting) as (address, _),
        robot(address, template) as client,
    ):
        with pytest.raises(RequestFailed, match=rf"{says}$") as failed:
            ask(client, REQUEST)
        assert str(failed.value).isprintable()


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


def test_a_description_of_the_server_is_for_websocket_alone() -> None:
    transport = TRANSPORTS["zmq"]
    with pytest.raises(UsageError, match=r"`template` starvla: zmq does not read s2a\.answer; leave it out"):
        transport.require(Choice(transport.options(template="starvla"), cameras=2))
