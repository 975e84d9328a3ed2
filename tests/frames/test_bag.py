"""A ROS 2 recording as a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import open_source
from s2a_bench.frames.bag import Recording
from s2a_bench.frames.convert import yuyv_to_rgb
from s2a_bench.ros.messages import COMPRESSED_IMAGE, IMAGE
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource

TYPES = get_typestore(Stores.ROS2_JAZZY)
SHAPES = {"yuv422_yuy2": (48, 64, 2), "bgr8": (48, 64, 3), "rgb8": (48, 64, 3), "mono8": (48, 64)}
Messages = list[tuple[str, str, Any]]


def header() -> Any:
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


def image(data: np.ndarray, encoding: str, **fields: Any) -> Any:
    height, width, *_ = data.shape
    row = data.reshape(height, -1)
    whole = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": row.shape[1]}
    return TYPES.types[IMAGE](header=header(), data=row.reshape(-1), **(whole | fields))


def compressed(data: np.ndarray) -> Any:
    return TYPES.types[COMPRESSED_IMAGE](header=header(), format="png", data=data)


def pictures(encoding: str, n: int = 3) -> list[np.ndarray]:
    return [np.random.default_rng(seed).integers(0, 256, SHAPES[encoding], np.uint8) for seed in range(n)]


def record(path: Path, messages: Messages, plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Write a rosbag2 folder; message i at i ns."""
    connections: dict[str, Any] = {}
    with Writer(path, version=8, storage_plugin=plugin) as writer:
        for i, (topic, type_name, message) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=TYPES)
            writer.write(connections[topic], i, TYPES.serialize_cdr(message, type_name))
    return path


def camera(encoding: str, topic: str = "/camera/image_raw") -> Messages:
    return [(topic, IMAGE, image(picture, encoding)) for picture in pictures(encoding)]


Open = Callable[..., Recording]


@pytest.fixture
def opened() -> Iterator[Open]:
    """Open recordings at 64x48 that are closed after the test."""
    with ExitStack() as stack:

        def opened(where: Path | str, width: int = 64, height: int = 48) -> Recording:
            source = Recording(str(where), width, height)
            stack.callback(source.close)
            return source

        yield opened


class TestContract(FrameSourceSuite):
    @pytest.fixture(params=list(SHAPES))
    def make_source(self, request: pytest.FixtureRequest, tmp_path: Path) -> MakeSource:
        where = str(record(tmp_path / "bag", camera(request.param)))
        return lambda width, height: Recording(where, width, height)


@pytest.mark.parametrize("encoding", list(SHAPES))
@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("single", [False, True])
def test_pixels_come_back_in_order_and_start_over(
    tmp_path: Path, encoding: str, plugin: StoragePlugin, single: bool
) -> None:
    path = record(tmp_path / "bag", camera(encoding), plugin)
    if single:
        (path,) = (*path.glob("*.mcap"), *path.glob("*.db3"))
    source = open_source(f"bag:{path}", 64, 48)
    assert source.encoding == encoding
    expected = pictures(encoding)
    for i in range(7):
        np.testing.assert_array_equal(source.read().data, expected[i % 3])
    source.close()


def test_a_compressed_picture_is_decoded_to_bgr(tmp_path: Path, opened: Open) -> None:
    picture = pictures("bgr8")[0]
    path = record(tmp_path / "bag", [("/c", COMPRESSED_IMAGE, compressed(cv2.imencode(".png", picture)[1]))])
    frame = opened(path).read()
    assert frame.encoding == "bgr8"
    np.testing.assert_array_equal(frame.data, picture)


def test_yuyv_of_another_size_comes_as_bgr(tmp_path: Path, opened: Open) -> None:
    frame = opened(record(tmp_path / "bag", camera("yuv422_yuy2")), 32, 24).read()
    assert frame.encoding == "bgr8"
    expected = cv2.resize(yuyv_to_rgb(pictures("yuv422_yuy2")[0])[..., ::-1], (32, 24), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(frame.data, expected)


def test_the_first_image_topic_is_read_unless_another_is_named(tmp_path: Path, opened: Open) -> None:
    string = TYPES.types["std_msgs/msg/String"](data="x")
    path = record(
        tmp_path / "a bag?",
        [("/s", "std_msgs/msg/String", string), *camera("mono8", "/left"), *camera("bgr8", "/right")],
    )
    assert opened(path).encoding == "mono8"
    assert opened(f"{path}?topic=/right").encoding == "bgr8"
    with pytest.raises(SourceError, match=r"^`source`: .* has no image topic /s; it has /left, /right$"):
        opened(f"{path}?topic=/s")
    with pytest.raises(UsageError, match=r"\?topic=/name"):
        opened(f"{path}?topic=left")


def test_a_recording_without_images_says_what_it_has(tmp_path: Path, opened: Open) -> None:
    path = record(tmp_path / "bag", [("/s", "std_msgs/msg/String", TYPES.types["std_msgs/msg/String"](data="x"))])
    with pytest.raises(SourceError, match=r"no topic of type sensor_msgs/msg/Image .*, only std_msgs/msg/String"):
        opened(path)


def test_an_image_topic_without_messages_is_no_endless_loop(tmp_path: Path, opened: Open) -> None:
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/empty", IMAGE, typestore=TYPES)
    with pytest.raises(SourceError, match="holds no picture on /empty"):
        opened(tmp_path / "bag")


@pytest.mark.parametrize("name", ["x.mcap", "x.db3", "x.txt"])
@pytest.mark.parametrize("content", [b"", b"no recording", b"\x89MCAP0\r\n" + bytes(100)])
def test_a_file_that_is_none_is_named(tmp_path: Path, name: str, content: bytes, opened: Open) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SourceError, match=rf"^`source`: .*{name} (is not a recording|has no topic)"):
        opened(path)


def test_a_folder_that_is_none_is_named(tmp_path: Path, opened: Open) -> None:
    with pytest.raises(SourceError, match=r"^`source`: .* is not a recording"):
        opened(tmp_path)


LAUGHS = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [1, 2\nb: }", "expected ',' or ']', but got ':' in \"<unicode string>\", line 2"),
        ("a:\n\t- b", "found character '\\t' that cannot start any token in \"<unicode string>\", line 2"),
        ("a: " + "[" * 1000, "maximum recursion depth exceeded"),
        (LAUGHS + "rosbag2_bagfile_information: {version: 5, relative_file_paths: *a29}", "Invalid bag metadata"),
        ("a: &a {}\nb:\n  <<: *a", "metadata.yaml: merged keys (<<) and tags are not read"),
        ("a: &a {}\nb: {!!merge x: *a}", "metadata.yaml: merged keys (<<) and tags are not read"),
        ("[]", "Invalid bag metadata: list indices must be integers"),
    ],
    ids=["syntax", "tab", "deep", "laughs", "merged", "merged by a tag", "list"],
)
def test_yaml_that_is_none_is_one_line(tmp_path: Path, text: str, reason: str, opened: Open) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(SourceError) as error:
        opened(tmp_path)
    (line,) = str(error.value).splitlines()
    assert f"{tmp_path} is not a recording that can be read (" in line
    assert reason in line
    assert len(line) < 600


def test_a_recording_cut_short_says_how_to_repair_it(tmp_path: Path, opened: Open) -> None:
    path = record(tmp_path / "bag", camera("bgr8")) / "bag.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(SourceError, match="mcap recover"):
        opened(path)


BGR, MONO = pictures("bgr8")[0], pictures("mono8")[0]


@pytest.mark.parametrize(
    ("type_name", "message", "says"),
    [
        (IMAGE, image(BGR, "bgr8", height=49), ".* bgr8 has 9216 bytes"),
        (IMAGE, image(MONO, "32FC1"), "image encoding '32FC1' is depth"),
        (COMPRESSED_IMAGE, compressed(np.zeros(9, np.uint8)), "9 bytes of format 'png': neither a JPEG nor a PNG$"),
    ],
)
def test_a_picture_that_cannot_be_read_is_one_line(
    tmp_path: Path, type_name: str, message: Any, says: str, opened: Open
) -> None:
    with pytest.raises(SourceError, match=rf"^`source`: .*picture 0 cannot be read: {says}"):
        opened(record(tmp_path / "bag", [("/c", type_name, message)]))


def test_a_change_of_format_is_refused(tmp_path: Path, opened: Open) -> None:
    source = opened(record(tmp_path / "bag", [*camera("bgr8"), *camera("mono8")]))
    for _ in range(3):
        source.read()
    with pytest.raises(SourceError, match="changes from bgr8 at 64x48 to mono8 at 64x48"):
        source.read()
