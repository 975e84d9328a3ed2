"""zenoh-ros2-sdk, whose keys, hashes, tokens and attachments are its own work, and we understand each other."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.frames import open_source
from s2a_bench.plugins.zenoh import endpoint_of, free_endpoint
from s2a_bench.ros import Middleware, QoS, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.types import Frame
from tests.plugins.zenoh.zenoh_peer import write_definitions
from tests.ros.middleware_suite import GET_TYPES, STRING, WAIT_S, text, until

pytestmark = pytest.mark.skipif(
    not (find_spec("zenoh") and find_spec("zenoh_ros2_sdk")), reason="zenoh-ros2-sdk, a peer, is not installed"
)
SCRIPT = Path(__file__).with_name("zenoh_peer.py")
NAME = "/robot/node/get_parameter_types"


@pytest.fixture
def ours(stack: ExitStack) -> Middleware:
    """Our node, which is the router too."""
    router = free_endpoint()
    middleware = open_middleware("zenoh", domain_id=0, place=router, host=True, node_name="/robot/ours")  # as the SDK's
    stack.callback(middleware.close)
    return middleware


Peer = Callable[[str, str], Callable[[], Any]]


@pytest.fixture
def peer(ours: Middleware, stack: ExitStack, tmp_path: Path) -> Peer:
    """Start a node of the SDK in a role; what is returned reads its next line."""
    write_definitions(tmp_path)

    def start(role: str, name: str) -> Callable[[], Any]:
        port = endpoint_of(str(ours.describe()["router"]))[2]
        command = [sys.executable, str(SCRIPT), str(port), str(tmp_path), role, name]
        alone = {**os.environ, "HOME": str(tmp_path), "GIT_ALLOW_PROTOCOL": "file"}  # it would fetch definitions
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=alone)
        stack.callback(process.communicate)
        lines = process.stdout

        def read() -> Any:
            for line in lines:
                if line.startswith("{"):
                    return json.loads(line)
            raise AssertionError("the peer ended")

        assert read() == {"ready": role}
        return read

    return start


@pytest.mark.parametrize(("width", "height"), [(64, 48), (1920, 1080)])
def test_it_sees_our_camera(ours: Middleware, peer: Peer, width: int, height: int) -> None:
    camera = ours.publisher("/robot/camera/image_raw", ros.IMAGE, QoS(1))
    read = peer("sees", "/robot/camera/image_raw")
    until(camera.matched)
    pixels = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    message = ros.image_message(Frame(0, 0, width, height, "bgr8", pixels), 5, "camera")
    camera.send(camera.pack(message))
    sha = hashlib.sha256(pixels.tobytes()).hexdigest()
    assert read() == {"size": [width, height], "encoding": "bgr8", "sha": sha}


def test_we_hear_its_topics(ours: Middleware, peer: Peer) -> None:
    heard = ours.subscription("/chatter", STRING, QoS())
    peer("says", "/chatter")
    packed = heard.take(WAIT_S)
    assert heard.unpack(packed).data.startswith("say ")
    until(heard.matched)


def test_its_camera_is_a_source(ours: Middleware, peer: Peer) -> None:
    peer("films", "/front/image")
    where = f"/front/image?middleware=zenoh&domain_id=0&router={ours.describe()['router']}"
    with closing(open_source(f"ros:{where}", 16, 12)) as source:
        frames = [source.read() for _ in range(3)]
    numbers = [int(frame.data[0, 0, 0]) for frame in frames]
    assert all(np.all(frame.data == number) for frame, number in zip(frames, numbers, strict=True))
    assert len({*numbers}) == 3


def test_texts_of_every_length_arrive(ours: Middleware, peer: Peer) -> None:
    said = ours.publisher("/chatter", STRING, QoS(0))
    read = peer("hears", "/chatter")
    until(said.matched)
    for length in range(9):
        said.send(said.pack(text("x" * length)))
    assert [len(read()["data"]) for _ in range(9)] == [*range(9)]


def test_it_calls_our_services(ours: Middleware, peer: Peer) -> None:
    ours.service(NAME, GET_TYPES, lambda asked: ros.default(GET_TYPES + "_Response", types=[*map(len, asked.names)]))
    assert peer("asks", NAME)() == {"types": [1, 4]}


def test_we_call_its_services(ours: Middleware, peer: Peer) -> None:
    peer("offers", NAME)
    client = ours.service_client(NAME, GET_TYPES)
    assert client.call(ros.default(GET_TYPES + "_Request", names=["ab", ""]), WAIT_S).types.tolist() == [2, 0]
