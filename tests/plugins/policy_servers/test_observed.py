"""What a server makes of an observation with any keys."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed
from s2a_bench.frames.convert import encode_png
from s2a_bench.plugins.policy_servers.observation import EXTENSION
from s2a_bench.plugins.policy_servers.observed import (
    extension_of,
    read_observation,
    remote_message,
    remote_of,
    request_of,
    take_extension,
)
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import LIMITS, Limits
from s2a_bench.types import Request

PICTURE = np.random.default_rng(1).integers(0, 256, (4, 6, 3), np.uint8)


def of(observation: Any, limits: Limits = LIMITS) -> Any:
    return read_observation(observation, Trace(), limits)


def test_keys_of_any_policy() -> None:
    images, state, prompt = of(
        {
            "observation/exterior_image_1_left": PICTURE,
            "note": "first text",
            "images": {"cam_high": PICTURE.transpose(2, 0, 1)},
            "observation/joint_position": np.arange(3.0),
            "gripper": 0.25,
            "steps": 7,
            "reset": True,
            "prompt": "go",
        }
    )
    assert [image.data.tolist() for image in images] == [PICTURE.tolist()] * 2
    assert [(image.encoding, image.width, image.height) for image in images] == [("rgb8", 6, 4)] * 2
    assert state == (0.0, 1.0, 2.0, 0.25)
    assert prompt == "go"


def test_axes_of_batch_and_time_are_pictures_one_after_the_other() -> None:
    images, _, prompt = of({"video": np.stack([PICTURE, 255 - PICTURE])[None], "language": [["walk"]]})
    np.testing.assert_array_equal(images[1].data, 255 - PICTURE)
    assert prompt == "walk"


@pytest.mark.parametrize("whole", [True, False])
def test_files_are_decoded(whole: bool) -> None:
    trace, file = Trace(), encode_png(PICTURE[..., ::-1])
    (image,), _, _ = read_observation({"image": file.tobytes() if whole else file}, trace, LIMITS)
    np.testing.assert_array_equal(image.data, PICTURE)
    assert [stage for stage, _ in trace.marks] == ["image_decode"]


def test_nothing_is_an_observation_too() -> None:
    assert of({}) == ((), (), "")


@pytest.mark.parametrize(
    ("observation", "says"),
    [
        (5, "an observation is a dictionary, not int"),
        ({"a": {"b": np.zeros((4, 4), np.uint8)}}, r"a.b: a picture of shape \(4, 4\)"),
        ({"a": np.zeros((4, 0, 3), np.uint8)}, "0x4 is empty"),
        ({"a": b"abc"}, "a: the 3 bytes .*: neither a JPEG nor a PNG"),
        ({"a": b""}, "a: an empty picture"),
        ({"a": np.zeros((99, 2, 2, 3), np.uint8)}, "a: 99 pictures"),
        ({"a": [PICTURE] * 99}, "more than 64 pictures"),
        ({"a": np.zeros((64, 64, 3))}, "a: a state of more than 4096 numbers; pictures are uint8"),
        ({"a": float("nan")}, "not finite"),
        ({"prompt": "\ud800"}, "no Unicode text"),
    ],
)
def test_what_can_be_no_observation_is_refused_in_a_line(observation: Any, says: str) -> None:
    with pytest.raises(RequestFailed, match=says):
        of(observation)


def test_pixels_are_bounded() -> None:
    with pytest.raises(RequestFailed, match="at most 20 pixels"):
        of({"a": PICTURE}, Limits(pixels=20))


def test_depth_is_bounded() -> None:
    deep: Any = "x"
    for _ in range(100):
        deep = {"a": deep}
    with pytest.raises(RequestFailed, match="in each other"):
        of(deep)


PLAIN = Remote("c", [("queue", 1)], [2]).to_json()


def test_a_request_s_own_fields_come_back_and_leave_the_observation() -> None:
    request = Request("a", "go", max_tokens=3, seed=7, grammar="root ::= 'x'")
    message = {"prompt": "go", EXTENSION: extension_of(request)}
    assert request_of(message, take_extension(message), Trace(), LIMITS) == request
    assert message == {"prompt": "go"}


def test_marks_come_back() -> None:
    assert remote_of(remote_message(Remote("c", [("queue", 1)], [2]))) == Remote("c", [("queue", 1)], [2])


@pytest.mark.parametrize(
    "message",
    [
        *(None, 5, [], "s2a", {}, np.zeros(3), {EXTENSION: None}, {EXTENSION: np.zeros(3)}),
        *({EXTENSION: {**PLAIN, name: 5}} for name in ("clock", "marks", "token_ns", "facts")),
        {EXTENSION: {**PLAIN, "marks": [("queue", -1)]}},
    ],
    ids=str,
)
def test_marks_that_are_none_are_refused_in_a_line(message: Any) -> None:
    with pytest.raises(RequestFailed, match=r"^what should be the server's marks is none: .") as failed:
        remote_of(message)
    assert str(failed.value).isprintable()


def test_what_is_no_map_is_no_word_of_ours() -> None:
    assert take_extension(np.zeros(3)) is None
    with pytest.raises(RequestFailed, match="s2a should be a map"):
        take_extension({EXTENSION: [1]})
