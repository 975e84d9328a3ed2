"""Interface files, type hashes and bytes against what a real ROS 2 wrote (tests/data, both versions of llama_msgs)."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.ros import llama
from s2a_bench.ros import messages as ros
from s2a_bench.types import Frame

DATA = Path(__file__).parent.parent / "data"
JAZZY = json.loads((DATA / "ros2_type_hashes.json").read_text())
LLAMA_6 = json.loads((DATA / "llama_msgs_6.json").read_text())
SAMPLES = [("4.4", sample) for sample in json.loads((DATA / "action_wire.json").read_text())["samples"]]
SAMPLES += [("6.0", sample) for sample in LLAMA_6["samples"]]
HASHES = {"4.4": JAZZY, "6.0": JAZZY | LLAMA_6["hashes"]}


pytestmark = pytest.mark.skipif(os.environ.get("ROS_DISTRO") == "humble", reason="the recordings are Jazzy's")


@pytest.mark.parametrize(("version", "at_least"), [("4.4", 171), ("6.0", 171)])
def test_every_type_hash_is_that_of_a_real_ros(version: str, at_least: int) -> None:
    known = [name for name in HASHES[version] if name in ros.typestore(version).fielddefs]
    assert len(known) >= at_least
    assert {name: ros.type_hash(name, version) for name in known} == {name: HASHES[version][name] for name in known}


@pytest.mark.parametrize(
    ("version", "sample"), SAMPLES, ids=[f"{version}-{n}" for n, (version, _) in enumerate(SAMPLES)]
)
def test_recorded_samples_are_read_and_written_byte_for_byte(version: str, sample: dict[str, str]) -> None:
    recorded = bytes.fromhex(sample["hex"])
    message = ros.deserialise(memoryview(recorded), sample["type"], version)
    written = ros.serialise(message, sample["type"], version)
    assert written[4 : len(recorded)] == recorded[4:]
    assert written[len(recorded) :] == bytes(-len(recorded) % 4)


def recorded_goal(version: str) -> Any:
    """The goal of the first recorded goal request."""
    of, sample = next((of, sample) for of, sample in SAMPLES if of == version and "SendGoal_Request" in sample["type"])
    request = ros.deserialise(memoryview(bytes.fromhex(sample["hex"])), sample["type"], of)
    return getattr(request, "body", request).goal


@pytest.mark.parametrize(
    ("version", "first_pixel", "extra"),
    [("4.4", 0, {}), ("6.0", 1, {"reset": True, "grammar": 'root ::= "a"'})],
)
def test_a_goal_has_the_defaults_that_ros_encodes(version: str, first_pixel: int, extra: dict[str, Any]) -> None:
    pixels = np.arange(first_pixel, first_pixel + 6, dtype=np.uint8).reshape(1, 2, 3)
    frame = Frame(0, 0, 2, 1, "rgb8", pixels)
    image = ros.image_message(frame, 1_000_000_002, "cam")
    goal = llama.generate_goal("quick", [image], stop=["</s>"], version=version, **extra)
    name = llama.GENERATE_RESPONSE + "_Goal"
    assert ros.serialise(goal, name, version) == ros.serialise(recorded_goal(version), name, version)


def test_images_of_a_goal_are_found_in_both_versions() -> None:
    assert [len(llama.goal_images(recorded_goal(version))) for version in ("4.4", "6.0")] == [1, 1]
    assert llama.goal_images(llama.generate_goal("p", version="4.4")) == []


def test_llama_msgs_4_4_takes_one_image() -> None:
    with pytest.raises(UsageError, match="one image in a goal, not 2"):
        llama.generate_goal("p", [None, None], version="4.4")
