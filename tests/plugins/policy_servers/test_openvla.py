"""OpenVLA's action server and its relatives: observations in, actions out, nothing streamed."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import json_numpy
import numpy as np
import pytest

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.frames.convert import decode_image, yuyv_to_rgb
from s2a_bench.testing.transport import ask, wiring_of, yuyv_frame
from s2a_bench.trace import Trace, budget
from s2a_bench.transport import open_client
from s2a_bench.types import Frame, Request
from tests.servers.sockets import Received, Reply, head, serving

STATE = (0.5, -0.25, 1.0)
ACTION = np.array([0.5, -0.25, 0.0, 1e-3, 0.0, 0.0, 1.0])


def asked(reply: Reply, *frames: Frame, state: tuple[float, ...] = (), **more: str) -> tuple[Any, Trace]:
    """Ask a server for a token, or with a template for actions."""
    with serving(reply) as url:
        wiring = wiring_of("http/as-deployed", url=url, **{"payload": "raw", "dialect": "openvla", **more})
        with closing(open_client(wiring)) as client:
            return ask(client, Request("a", "pick up the cup", frames, state=state))


def answering(body: str) -> tuple[Reply, list[Received]]:
    """Answer with a body; returns the reply, and what will have come."""
    seen: list[Received] = []

    def reply(received: Received) -> list[bytes]:
        seen.append(received)
        return [head(kind="application/json") + body.encode()]

    return reply, seen


def says(body: str) -> Reply:
    return answering(body)[0]


@pytest.mark.parametrize("encoding", ["yuv422_yuy2", "bgr8", "rgb8"])
def test_the_pixels_arrive_as_rgb_and_the_action_comes_back_as_one_token(encoding: str) -> None:
    yuyv = yuyv_frame()
    rgb = yuyv_to_rgb(yuyv.data)
    data = {"yuv422_yuy2": yuyv.data, "bgr8": np.ascontiguousarray(rgb[:, :, ::-1]), "rgb8": rgb}[encoding]
    frame = Frame(0, 0, 64, 48, encoding, data)  # type: ignore[arg-type]
    deploy, seen = answering(json_numpy.dumps(ACTION))  # ``vla-scripts/deploy.py`` after ``json_numpy.patch()``
    (token,), trace = asked(deploy, frame, served_model="bridge_orig")
    payload = json_numpy.loads(seen[0].body)
    assert payload["instruction"] == "pick up the cup"
    assert payload["unnorm_key"] == "bridge_orig"
    np.testing.assert_array_equal(payload["image"], rgb)
    assert (payload["image"].dtype, seen[0].path) == (np.uint8, "/act")
    assert json.loads(token.text) == ACTION.tolist()
    assert trace.facts["action_n"] == 7
    spent = budget(trace.chain())
    converts = set() if encoding == "rgb8" else {"convert"}
    assert set(spent.stages_ns) == {"base64_encode", "json_pack", "server"} | converts


@pytest.mark.parametrize(
    "encode",
    [
        lambda action: json_numpy.dumps(action.astype(np.float32)),
        lambda action: json.dumps(json_numpy.dumps(action)),  # a server that got `encoded`
        lambda action: json.dumps(action.tolist()),
        lambda action: json_numpy.dumps(np.stack([action, action])),
        lambda action: json_numpy.dumps([action, action]),
    ],
)
def test_an_action_in_any_of_its_forms_is_read(encode: Callable[[np.ndarray], str]) -> None:
    deploy, seen = answering(encode(ACTION))
    (token,), trace = asked(deploy)
    assert seen[0].json == {"instruction": "pick up the cup"}  # without a key of statistics
    np.testing.assert_allclose(np.array(json.loads(token.text)).reshape(-1)[:7], ACTION, rtol=1e-6)
    assert trace.facts["action_n"] in {7, 14}


@pytest.mark.parametrize(
    ("template", "body", "message"),
    [
        ("", '"error"', "the server answered 'error'; the reason is in the server's output"),
        ("", '{"detail": "no such route"}', "broke off: no such route"),
        ("", "null", "finite numbers"),
        ("", "[[1], [1, 2]]", "not the dialect 'openvla'"),
        ("", "[NaN]", "finite numbers"),
        ("", '{"__numpy__": "AAAA", "dtype": "O", "shape": [1]}', "not the dialect 'openvla'"),
        ("", '{"__numpy__": "AAAA", "dtype": "<f8", "shape": [7]}', "not the dialect 'openvla'"),
        ("", "{}", "not the dialect 'openvla'"),
        ("", "", "not the dialect 'openvla'"),
        ("x-vla", '{"actions": [[1]]}', "an answer without action: actions"),
        ("x-vla", '{"action": [[NaN]]}', "actions: not finite numbers"),
        ("x-vla", '{"action": null}', "not numbers of shape"),
        ("x-vla", '{"error": "Request failed"}', "broke off: Request failed"),
        ("openvla-oft", '"error"', "the server answered 'error'; the reason is in the server's output"),
        ("openvla-oft", "[[1], [1, 2]]", "not an array of numbers"),
    ],
)
def test_what_is_no_action_is_a_failure(template: str, body: str, message: str) -> None:
    with pytest.raises(RequestFailed, match=message):
        asked(says(body), yuyv_frame(), state=STATE if template else (), **({"template": template} if template else {}))


OFT = [np.array([0.5, -0.25, float(tick)]) for tick in range(4)]
CHUNK = [[0.5, -0.25, 0.0], [0.5, -0.25, 1.0]]
PICTURES = (yuyv_frame(seed=1), yuyv_frame(seed=2), yuyv_frame(seed=3))


def test_openvla_oft_is_sent_its_observation_and_answers_a_list_of_arrays() -> None:
    """``JSONResponse(action)`` of ``get_vla_action``'s list, after ``json_numpy.patch()``."""
    deploy, seen = answering(json_numpy.dumps(OFT))
    actions, trace = asked(deploy, *PICTURES, state=STATE, template="openvla-oft", served_model="libero")
    payload = json_numpy.loads(seen[0].body)
    told = seen[0].path, payload.pop("instruction"), payload.pop("unnorm_key")
    assert told == ("/act", "pick up the cup", "libero")
    np.testing.assert_array_equal(payload.pop("state"), np.array(STATE, np.float32))
    assert list(payload) == ["full_image", "left_wrist_image", "right_wrist_image"]
    for picture, frame in zip(payload.values(), PICTURES, strict=True):
        np.testing.assert_array_equal(picture, yuyv_to_rgb(frame.data))
    np.testing.assert_array_equal([action.values for action in actions], OFT)
    assert [action.index for action in actions] == [0, 1, 2, 3]
    assert trace.facts["action_n"] == 12
    assert set(budget(trace.chain()).stages_ns) == {"convert", "base64_encode", "json_pack", "server"}


def test_x_vla_is_sent_arrays_as_texts_and_answers_an_object() -> None:
    act, seen = answering(json.dumps({"action": CHUNK}))
    actions, _ = asked(act, *PICTURES[:2], state=STATE, template="x-vla", extra_body='{"domain_id": 3}')
    payload = seen[0].json
    assert (payload["language_instruction"], payload["domain_id"], payload["steps"]) == ("pick up the cup", 3, 10)
    assert "image2" not in payload
    np.testing.assert_array_equal(json_numpy.loads(payload["image1"]), yuyv_to_rgb(PICTURES[1].data))
    np.testing.assert_array_equal(json_numpy.loads(payload["proprio"]), np.array(STATE, np.float32))
    np.testing.assert_array_equal([action.values for action in actions], CHUNK)


def test_sglang_is_sent_lists_and_answers_an_envelope() -> None:
    """sgl-project/sglang 0350f48f, action/protocol.py: action_generation_response, as JSON."""
    action = {"type": "continuous", "dtype": "float32", "shape": [2, 3], "values": CHUNK}
    answer = {"object": "action.generation", "data": [{"index": 0, "input_index": 0, "action": action}]}
    generations, seen = answering(json.dumps(answer))
    actions, _ = asked(generations, *PICTURES[:2], state=STATE, template="sglang-http")
    given = seen[0].json["input"]
    assert (seen[0].path, given["task"]) == ("/v1/actions/generations", "pick up the cup")
    assert list(given["observation"]["images"]) == ["base_0_rgb", "left_wrist_0_rgb"]
    assert given["observation"]["images"]["left_wrist_0_rgb"] == yuyv_to_rgb(PICTURES[1].data).tolist()
    assert given["observation"]["state"] == list(STATE)
    np.testing.assert_array_equal([action.values for action in actions], CHUNK)


def test_the_file_of_a_picture_is_an_array_of_its_bytes(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('images = ["{image:0|bytes}", "{prompt}"]\ns2a = {answer = "", path = "/v1/act"}\n')
    reply, seen = answering("[1, 2]")
    asked(reply, PICTURES[0], template=str(mine), payload="jpeg")
    picture, prompt = json_numpy.loads(seen[0].body)["images"]
    assert decode_image(picture.tobytes()).shape == (48, 64, 3)
    assert (prompt, seen[0].path) == ("pick up the cup", "/v1/act")


OF_ACTIONS = {"dialect": "openvla"}


@pytest.mark.parametrize(
    ("options", "cameras", "message"),
    [
        (OF_ACTIONS | {"template": "openvla-oft"}, 4, "`template` openvla-oft has places for 3 pictures, not 4"),
        (OF_ACTIONS | {"template": "vllm-omni-openvla"}, 1, "vllm-omni-openvla: openvla does not read s2a.idle_s"),
        ({"dialect": "vllm", "template": "x-vla"}, 1, "the dialect 'vllm' takes none"),
        ({"template": "x-vla"}, 1, "the dialect 'openai' takes none; .*`dialect` openvla"),
    ],
)
def test_a_template_that_does_not_fit_is_refused_in_a_line(options: dict[str, str], cameras: int, message: str) -> None:
    url = "http://127.0.0.1:1"
    with pytest.raises(UsageError, match=message):
        LatencyConfig(transports="http", url=url, cameras=cameras, options={"http": options})
