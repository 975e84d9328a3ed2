"""OpenVLA's action server: pixels in, an action out, nothing streamed."""

from __future__ import annotations

import json
from collections.abc import Callable

import json_numpy
import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.testing.transport import ask, wiring_of, yuyv_frame
from s2a_bench.trace import Trace, budget
from s2a_bench.transport import open_client
from s2a_bench.types import Frame, Request, Token
from tests.servers.sockets import Received, Reply, head, serving

ACTION = np.array([0.5, -0.25, 0.0, 1e-3, 0.0, 0.0, 1.0])


def json_head(body: bytes) -> bytes:
    return head(kind="application/json") + body


def act(reply: Reply, frame: Frame | None = None, **more: str) -> tuple[list[Token], Trace]:
    with serving(reply) as url:
        client = open_client(wiring_of("http/as-deployed", url=url, payload="raw", dialect="openvla", **more))
        try:
            return ask(client, Request("a", "pick up the cup", (frame,) if frame else ()))
        finally:
            client.close()


def says(body: str) -> Reply:
    return lambda _: [json_head(body.encode())]


@pytest.mark.parametrize("encoding", ["yuv422_yuy2", "bgr8", "rgb8"])
def test_the_pixels_arrive_as_rgb_and_the_action_comes_back_as_one_token(encoding: str) -> None:
    seen: list[Received] = []
    yuyv = yuyv_frame()
    rgb = yuyv_to_rgb(yuyv.data)
    data = {"yuv422_yuy2": yuyv.data, "bgr8": np.ascontiguousarray(rgb[:, :, ::-1]), "rgb8": rgb}[encoding]
    frame = Frame(0, 0, 64, 48, encoding, data)  # type: ignore[arg-type]

    def deploy(received: Received) -> list[bytes]:
        """``vla-scripts/deploy.py`` after ``json_numpy.patch()``."""
        seen.append(received)
        return [json_head(json_numpy.dumps(ACTION).encode())]

    (token,), trace = act(deploy, frame, served_model="bridge_orig")
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


def test_without_a_key_of_statistics_none_is_sent() -> None:
    seen: list[Received] = []
    act(lambda received: seen.append(received) or [json_head(json_numpy.dumps(ACTION).encode())])
    assert seen[0].json == {"instruction": "pick up the cup"}


@pytest.mark.parametrize(
    "encode",
    [
        lambda action: json_numpy.dumps(action.astype(np.float32)),
        lambda action: json.dumps(json_numpy.dumps(action)),  # a server that got `encoded`
        lambda action: json.dumps(action.tolist()),
        lambda action: json_numpy.dumps(np.stack([action, action])),
    ],
)
def test_an_action_in_any_of_its_forms_is_read(encode: Callable[[np.ndarray], str]) -> None:
    (token,), trace = act(says(encode(ACTION)))
    np.testing.assert_allclose(np.array(json.loads(token.text)).reshape(-1)[:7], ACTION, rtol=1e-6)
    assert trace.facts["action_n"] in {7, 14}


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('"error"', "the server answered 'error'; the reason is in the server's output"),
        ('{"detail": "no such route"}', "broke off: no such route"),
        ("[]", "no finite numbers"),
        ("null", "no finite numbers"),
        ("[[1], [1, 2]]", "not the dialect 'openvla'"),
        ("[NaN]", "no finite numbers"),
        ('{"__numpy__": "AAAA", "dtype": "O", "shape": [1]}', "an action of type O"),
        ('{"__numpy__": "AAAA", "dtype": "<f8", "shape": [7]}', "not the dialect 'openvla'"),
        ("{}", "not the dialect 'openvla'"),
        ('"pick"', "not the dialect 'openvla'"),
        ("", "not the dialect 'openvla'"),
    ],
)
def test_what_is_no_action_is_a_failure(body: str, message: str) -> None:
    with pytest.raises(RequestFailed, match=message):
        act(says(body))


def test_a_body_of_another_type_is_a_failure() -> None:
    with pytest.raises(RequestFailed, match="answered 500: Internal Server Error"):
        act(lambda _: [head("500 Internal Server Error", "text/plain") + b"Internal Server Error"])
