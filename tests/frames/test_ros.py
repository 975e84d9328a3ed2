"""A ROS 2 topic as a camera."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2
import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import FrameSource, open_source
from s2a_bench.frames.ros import TopicCamera
from s2a_bench.ros import Middleware, QoS, config, default_middleware, open_middleware
from s2a_bench.ros import messages as ros
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource
from s2a_bench.types import Pixels
from tests.suites import once
from tests.waiting import until

TOPIC = "/front/camera/image"
SHAPES = {"bgr8": (48, 64, 3), "rgb8": (48, 64, 3), "bgra8": (48, 64, 4), "mono8": (48, 64), "yuv422_yuy2": (48, 64, 2)}


def image(data: Pixels, encoding: str, **fields: Any) -> Any:
    height, width, *_ = data.shape
    row = data.reshape(height, -1)
    whole = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": row.shape[1]}
    return ros.message(ros.IMAGE, header=ros.header(1), data=row.reshape(-1), **(whole | fields))


def png(picture: Pixels) -> Any:
    return ros.compressed_image_message(cv2.imencode(".png", picture)[1], 1, "camera", "png")


def pictures(encoding: str, n: int = 7) -> list[Pixels]:
    return [np.random.default_rng(100 + seed).integers(0, 256, SHAPES[encoding], np.uint8) for seed in range(n)]


@dataclass
class Camera:
    """A node that publishes, and what `--source` has after the topic to meet it."""

    node: Middleware
    meet: str

    def publisher(self, messages: list[Any], qos: QoS, topic: str = TOPIC) -> Callable[[], None]:
        """Return what publishes the next message."""
        type_name = messages[0].__msgtype__
        publisher = self.node.publisher(topic, type_name, qos)
        packed = cycle([publisher.pack(message) for message in messages])
        return lambda: publisher.send(next(packed))

    def source(self, width: int = 64, height: int = 48, topic: str = TOPIC, wait_s: float = 20) -> FrameSource:
        return open_source(f"ros:{topic}?wait_s={wait_s}{self.meet}", width, height)


@pytest.fixture
def camera(from_pypi: str, place: str, stack: ExitStack) -> Camera:
    """A camera over each middleware that comes from PyPI; where nodes meet at a place, it is that, too."""
    node = stack.enter_context(closing(open_middleware(from_pypi, node_name="/camera", place=place, host=True)))
    return Camera(node, f"&middleware={from_pypi}" + f"&router={place}" * bool(place))


@pytest.fixture
def running(stack: ExitStack) -> Callable[[Callable[[], None]], None]:
    """Call something again and again, on a thread, until the test ends."""

    def run(publish: Callable[[], None], period_s: float = 0.002) -> None:
        ended = Event()

        def work() -> None:
            while not ended.wait(period_s):
                publish()

        thread = Thread(target=work)
        thread.start()
        stack.callback(thread.join)
        stack.callback(ended.set)

    return run


Running = Callable[[Callable[[], None]], None]


class TestContract(FrameSourceSuite):
    """Of a reliable camera; where a middleware is the second, the pictures are compressed."""

    @pytest.fixture
    def make_source(self, from_pypi: str, camera: Camera, running: Running) -> MakeSource:
        messages = [image(picture, "bgr8") for picture in pictures("bgr8")]
        if from_pypi != default_middleware({}):
            messages = [png(picture) for picture in pictures("bgr8")]
        running(camera.publisher(messages, QoS(1)))
        return camera.source


@once
@pytest.mark.parametrize("encoding", [*SHAPES, "png"])
def test_pixels_come_as_they_were_published_by_a_best_effort_camera(
    camera: Camera, running: Running, encoding: str
) -> None:
    compressed = encoding == "png"
    picture = pictures("bgr8" if compressed else encoding)[0]
    message = png(picture) if compressed else image(picture, encoding)
    running(camera.publisher([message], QoS(1, reliable=False)))
    with closing(camera.source()) as source:
        frame = source.read()
    if encoding == "bgra8":
        picture = picture[..., :3]
    expected = "bgr8" if encoding in {"bgra8", "png"} else encoding
    assert (source.encoding, frame.encoding) == (expected, expected)
    np.testing.assert_array_equal(frame.data, picture)


@pytest.mark.parametrize("reliable", [True, False])
def test_the_subscription_is_as_reliable_as_its_publishers(camera: Camera, running: Running, reliable: bool) -> None:
    messages = [image(pictures("mono8")[0], "mono8")]
    running(camera.publisher(messages, QoS(1)))
    running(camera.publisher(messages, QoS(1, reliable=reliable)))
    until(lambda: sum(offer.topic == TOPIC for offer in camera.node.offers()) == 2)
    with closing(camera.source()) as source:
        assert source.read().data.any()
        assert source._subscription.matched() == 2  # type: ignore[attr-defined]


@once
def test_the_newest_picture_wins_and_none_is_read_twice(camera: Camera) -> None:
    numbers = [np.full((48, 64), number, np.uint8) for number in range(256)]
    publish = camera.publisher([image(number, "mono8") for number in numbers], QoS(1))
    opened: list[FrameSource] = []
    thread = Thread(target=lambda: opened.append(camera.source(wait_s=2)))
    thread.start()
    sent = 0
    while thread.is_alive():  # the first picture opens it
        publish()
        sent += 1
        time.sleep(0.01)
    (source,) = opened
    for _ in range(20):
        publish()
    sent += 20
    newest = (sent - 1) % 256
    with closing(source):
        until(lambda: source._newest[0][-1] == newest)  # type: ignore[attr-defined]
        before = now_ns()
        frame = source.read()
        assert np.all(frame.data == newest)
        assert frame.stamp_ns <= before
        with pytest.raises(
            SourceError, match=rf"^`source`: ros:{TOPIC}.*: no picture for 2 s of 1 publisher; .*doctor"
        ):
            source.read()
        publish()
        assert np.all(source.read().data == sent % 256)
        camera.node.close()
        with pytest.raises(SourceError, match=r": no picture for 2 s of 0 publishers: start it again"):
            source.read()


def test_a_topic_without_a_publisher_lists_those_that_have_pictures(camera: Camera, running: Running) -> None:
    running(camera.publisher([image(pictures("mono8")[0], "mono8")], QoS(1), "/rear"))
    with pytest.raises(SourceError) as error:
        camera.source(wait_s=1)
    (line,) = str(error.value).splitlines()
    assert line.startswith(f"`source`: ros:{TOPIC}")
    assert f"{TOPIC} has no publisher after 1 s; topics of pictures here: /rear. Is ROS_DOMAIN_ID" in line


@once
def test_a_topic_of_another_type_is_named_at_once(camera: Camera, running: Running) -> None:
    running(camera.publisher([ros.message("std_msgs/msg/String", data="x")], QoS(1)))
    with pytest.raises(SourceError, match=rf"{TOPIC} is of type std_msgs/msg/String; topics of pictures here: none$"):
        camera.source(wait_s=600)


@once
@pytest.mark.parametrize(
    ("message", "says"),
    [
        (image(pictures("mono8")[0], "32FC1"), "image encoding '32FC1' is depth"),
        (image(pictures("bgr8")[0], "bgr8", step=2**32 - 1), "image of 64x48 bgr8 has 9216 bytes"),
        (png(np.zeros((7100, 7100), np.uint8)), "IMAGE_PIXELS"),
    ],
)
def test_a_picture_that_cannot_be_read_is_one_line(camera: Camera, running: Running, message: Any, says: str) -> None:
    running(camera.publisher([message], QoS(1)))
    with pytest.raises(SourceError) as error:
        camera.source()
    (line,) = str(error.value).splitlines()
    assert line.startswith(f"`source`: ros:{TOPIC}?wait_s=20")
    assert ": picture 0 cannot be read: " in line
    assert says in line


@once
def test_bytes_that_are_no_message_are_one_line(camera: Camera, running: Running) -> None:
    publisher = camera.node.publisher(TOPIC, ros.IMAGE, QoS(1))
    running(lambda: publisher.send(bytearray(b"\0\1\0\0" + b"\xff" * 64)))
    with pytest.raises(SourceError, match=rf"^`source`: ros:{TOPIC}.*: received bytes that are not a {ros.IMAGE}"):
        camera.source(wait_s=2)


@once
def test_frames_of_another_size_are_scaled_and_another_format_is_refused(camera: Camera) -> None:
    large, small = np.full((96, 128, 3), 7, np.uint8), np.full((24, 32, 3), 9, np.uint8)
    messages = [image(large, "bgr8"), image(small, "bgr8"), image(pictures("mono8")[0], "mono8")]
    publisher = camera.node.publisher(TOPIC, ros.IMAGE, QoS(1))
    source: list[FrameSource] = []
    thread = Thread(target=lambda: source.append(camera.source()))
    thread.start()
    while thread.is_alive():
        publisher.send(publisher.pack(messages[0]))
        time.sleep(0.01)
    with closing(source[0]) as opened:
        for message, value in zip(messages, (7, 9), strict=False):
            publisher.send(publisher.pack(message))
            until(lambda value=value: np.all(opened.read().data == value))  # type: ignore[misc]  # bound at once
        publisher.send(publisher.pack(messages[2]))
        with pytest.raises(SourceError, match="changes from bgr8 at 64x48 to mono8 at 64x48"):
            opened.read()


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("camera", "'ros:camera' should look like ros:/camera/image_raw"),
        ("/a b", "should look like"),
        ("/camera?domain=5", "'domain' is not a parameter; its parameters are middleware, domain_id, router, wait_s"),
        ("/camera?domain_id=500", "domain_id = '500'"),
        ("/camera?middleware=zmq", "middleware = 'zmq'"),
        ("/camera?wait_s=0", "wait_s = '0'"),
    ],
)
def test_what_is_no_topic_or_parameter_is_one_line(where: str, says: str) -> None:
    with pytest.raises(UsageError, match=r"^`source`: ") as error:
        TopicCamera(where, 64, 48)
    assert says in str(error.value)


@pytest.fixture
def typed_peer(dds_domain: int, stack: ExitStack) -> Callable[[str], None]:
    """Start a publisher in cyclonedds' own Python, in a process of its own."""
    pytest.importorskip("cyclonedds")

    def start(reliability: str) -> None:
        script = Path(__file__).parents[1] / "ros" / "typed_peer.py"
        xml = config.configuration({}, "default") or ""
        stack.enter_context(
            subprocess.Popen(
                [sys.executable, script, str(dds_domain), TOPIC, reliability],
                stdin=subprocess.PIPE,
                env={**os.environ, "CYCLONEDDS_URI": xml},
            )
        )

    return start


@pytest.mark.parametrize("reliability", ["reliable", "best-effort"])
def test_a_program_without_ros_that_describes_its_types_is_a_camera(
    typed_peer: Callable[[str], None], reliability: str
) -> None:
    typed_peer(reliability)
    with closing(open_source(f"ros:{TOPIC}?wait_s=30", 16, 12)) as source:
        numbers = [source.read().data for _ in range(20)]
    steps = np.diff([int(data[0, 0, 0]) for data in numbers]) % 256
    assert all(np.all(data == data[0, 0, 0]) and data.shape == (12, 16, 3) for data in numbers)
    assert np.all((steps > 0) & (steps < 128))
