"""Observations of policy servers, made from a template, and read by a server whatever their keys are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import RequestFailed, UsageError
from s2a_bench.frames.convert import encode_png
from s2a_bench.plugins.policy_servers.observation import DEFAULT, EXTENSION, Template, names, template_of
from s2a_bench.plugins.policy_servers.observed import (
    read_observation,
    remote_of,
    take_extension,
)
from s2a_bench.trace import Remote, Trace
from s2a_bench.transport.limits import LIMITS, Limits

FIRST, SECOND = (np.full((4, 6, 3), number, np.uint8) for number in (1, 2))
STATE = tuple(float(number) for number in range(8))


def filled(content: Any, pictures: Any = (FIRST, SECOND), state: Any = (), prompt: str = "go") -> Any:
    return Template(content, "mine").fill(pictures, state, prompt)


def equal(got: Any, expected: Any) -> bool:
    """Return True for the same values, whose arrays are of the same type."""
    if isinstance(expected, dict):
        return got.keys() == expected.keys() and all(equal(got[key], value) for key, value in expected.items())
    if isinstance(expected, np.ndarray):
        return got.dtype == expected.dtype and np.array_equal(got, expected)
    return type(got) is type(expected) and bool(got == expected)


def numbers(*values: float) -> Any:
    return np.array(values, np.float32)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"a": "{image}", "b": {"c": "{image:1}"}}, {"a": FIRST, "b": {"c": SECOND}}),
        ({"p": "{prompt}", "q": "Task: {prompt}; {{json}}"}, {"p": "{image}", "q": "Task: {image}; {json}"}),
        ({"all": "{state}", "first": "{state::2}"}, {"all": numbers(*range(8)), "first": numbers(0, 1)}),
        ({"arm": "{state:0:7}", "rest": "{state:7:}"}, {"arm": numbers(*range(7)), "rest": numbers(7)}),
        ({"video": [["{image}"]], "s": [["{state:7:8}"]]}, {"video": FIRST[None, None], "s": numbers(7)[None, None]}),
        ({"both": ["{image:0}", "{image:1}"]}, {"both": np.stack([FIRST, SECOND])}),
        ({"language": [["{prompt}"]], "other": [1, 2.5]}, {"language": [["{image}"]], "other": [1, 2.5]}),
        ({"flag": True, "none": None, "empty": []}, {"flag": True, "none": None, "empty": []}),
        ({"a": "{image:0|CHW}"}, {"a": FIRST.transpose(2, 0, 1)}),
        ({"a": "{image:1|bytes}"}, {"a": SECOND.tobytes()}),
        ({"a": "{image}", "b?": "{image:2}", "c?": {"d": ["{state:7:9}"]}, "p?": "x"}, {"a": FIRST, "p": "x"}),
        ({"c?": {"d": ["{state:7:8}"]}, "e?": "{images}"}, {"c": {"d": numbers(7)[None]}, "e": [FIRST, SECOND]}),
    ],
)
def test_places_become_pictures_state_and_prompt_which_is_not_read_again(content: Any, expected: Any) -> None:
    got = filled({"views?": "{images}", "state?": "{state}", **content}, state=STATE, prompt="{image}")
    assert equal({key: got[key] for key in got.keys() - {"views", "state"}}, expected)


def test_pictures_are_not_copied_but_for_their_colours_first() -> None:
    got = filled({"a": "{image}", "video": [["{image}"]], "c": "{image:0|CHW}", "b": "{image:1}"})
    assert got["a"] is FIRST
    assert np.shares_memory(got["video"], FIRST)
    assert got["c"].flags.c_contiguous
    assert Template({"b": "{image|bytes}"}, "mine").encoded


def test_a_session_is_of_one_client() -> None:
    one, other = (Template({"views?": "{images}", "id": "{session}"}, "mine") for _ in "ab")
    assert one.fill((), (), "") == one.fill((), (), "go") != other.fill((), (), "")
    assert len(one.fill((), (), "")["id"]) == 32


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"a": {"b": "{image:2}"}}, "a.b wants 3 pictures, and the request has 2"),
        ({"a": ["{image:1}"], "s": "{state:7:9}"}, r"s wants the state's numbers \(7:9\), and the request has 8"),
        ({"a": "{image}", "t": "{prompt}"}, "places for 1 pictures, not 2"),
        ({"a": "{image:1}"}, "no place for the robot's state"),
        ({"both": ["{image:0|CHW}", "{image:1}"]}, "both: all input arrays must have the same shape"),
    ],
)
def test_a_request_that_does_not_fit_is_refused_with_the_key(content: Any, says: str) -> None:
    with pytest.raises(RequestFailed, match=says):
        filled(content, state=STATE if "state" in says else ())


def deep() -> Any:
    content: Any = "{prompt}"
    for _ in range(40):
        content = [content]
    return {"a": content}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ([], "should be a table"),
        ({"a": "{picture}"}, "a has an unknown place"),
        ({"a": {"b": ["x", "{image:a}"]}}, r"a.b\[1\] has an unknown place"),
        ({"a": "{image:0|BGR}"}, "a wants picture 0 as BGR"),
        ({"a": "{image:99}"}, "a wants picture 99"),
        ({"a": "{state:7:7}"}, "a wants the numbers 7:7 of the state: an empty range"),
        ({"a": object()}, "which no observation can hold"),
        ({"a": 1, "a?": 2}, "a is twice there"),
        ({"?": 1}, "empty"),
        ({"s2a": {"anser": "x"}}, "s2a: anser: there is no such key; did you mean answer"),
        ({"s2a": {"path": "no/slash"}}, "s2a: path: 'no/slash' should match pattern"),
        ({"s2a": {"idle_s": 0}}, "s2a: idle_s: 0 should be greater than or equal to 1"),
        ({"s2a": {"reset": "x"}}, "s2a: reset: 'x' should be a table"),
        ({"a": "{image}", "s2a": [["a"]]}, "s2a: it should be a table of keys"),
        ({"a": "{image:0|bytes}", "s2a": {"image_maps": True}}, "a wants bytes, and s2a.image_maps has pictures as"),
    ],
)
def test_a_template_that_makes_no_sense_is_refused_with_the_key(content: Any, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        Template(content, "mine")


@pytest.mark.parametrize("name", names())
def test_those_with_names_can_be_filled(name: str) -> None:
    template = template_of(name)
    got = template.fill([FIRST] * template.pictures, range(17) if template.accepts_state else (), "go")
    assert got


def test_the_default_takes_what_there_is() -> None:
    template = template_of(DEFAULT)
    assert template.fill([], (), "go") == {"prompt": "go"}
    assert list(template.fill([FIRST, SECOND], STATE, "go")) == [
        "observation/image",
        "observation/wrist_image",
        "observation/state",
        "prompt",
    ]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.toml", '"observation/image" = "{image}"\n[x]\ny = [["{prompt}"]]\n'),
        ("a.json", '{"observation/image": "{image}", "x": {"y": [["{prompt}"]]}}'),
    ],
)
def test_toml_and_json_say_the_same(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    filled = template_of(str(tmp_path / name)).fill([FIRST], (), "go")
    assert filled == {"observation/image": FIRST, "x": {"y": [["go"]]}}


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.json", "{", "not JSON"),
        ("a.json", '{"a": 1, "a": 2}', "a key is twice there"),
        ("a.json", "[" * 50_000, "too deep"),
        ("a.toml", "a = ", "not TOML"),
        ("a.toml", "a = 2020-01-01", "which no observation can hold"),
    ],
)
def test_a_file_that_cannot_be_read_is_refused_in_a_line(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=says):
        template_of(str(tmp_path / name))


@pytest.mark.parametrize(("name", "says"), [("vllm-omni", "not one of aloha, droid"), ("no/such.toml", "cannot read")])
def test_an_unknown_name_is_refused(name: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        template_of(name)


PICTURE = np.random.default_rng(1).integers(0, 256, (4, 6, 3), np.uint8)


def of(observation: Any) -> Any:
    return read_observation(observation, Trace(), Limits(pixels=3000))


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
        ({"prompt": "\ud800"}, "not Unicode text"),
        ({"a": np.zeros((40, 80, 3), np.uint8)}, "at most 3000 pixels"),
        (deep(), "in each other"),
    ],
)
def test_what_can_be_no_observation_is_refused_in_a_line(observation: Any, says: str) -> None:
    assert of({}) == ((), (), "")
    with pytest.raises(RequestFailed, match=says):
        of(observation)


def test_what_is_no_map_is_no_word_of_ours() -> None:
    assert take_extension(np.zeros(3)) is None
    with pytest.raises(RequestFailed, match="s2a should be a map"):
        take_extension({EXTENSION: [1]})


MARKS = Remote("c", [("queue", 1)], [2])


@pytest.mark.parametrize(
    "message",
    [
        *(None, {}, np.zeros(3), {EXTENSION: None}, {EXTENSION: np.zeros(3)}),
        *({EXTENSION: {**MARKS.to_json(), name: 5}} for name in ("clock", "marks", "token_ns", "facts")),
        {EXTENSION: {**MARKS.to_json(), "marks": [("queue", -1)]}},
    ],
    ids=str,
)
def test_marks_come_back_and_those_that_are_none_are_refused_in_a_line(message: Any) -> None:
    assert remote_of({EXTENSION: MARKS.to_json()}) == MARKS
    with pytest.raises(RequestFailed, match=r"^the server's marks are malformed: .") as failed:
        remote_of(message)
    assert str(failed.value).isprintable()
