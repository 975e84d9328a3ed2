"""Frames of a ROS 2 recording (rosbag2 folder, ``.mcap`` or ``.db3`` file), in a loop."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, cast

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent

from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import NumberedSource, check_size
from s2a_bench.frames.convert import bgr_to_rgb, decode_image, resize, yuyv_to_bgr
from s2a_bench.types import Encoding, Pixels

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CHANNELS = {"yuv422_yuy2": 2, "bgr8": 3, "rgb8": 3, "mono8": 1}
TOPIC_KEY = "?topic="
METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 8 * 2**20
MAX_DEPTH = 32
"""The most nested lists and maps in a recording's YAML, which has 8."""
MOST_QUOTED = 300
"""Characters that are quoted of a library's error about a damaged file."""


class Recording(NumberedSource):
    """A recorded image topic as a camera, in the recorded encoding; CompressedImage is decoded to ``bgr8``.

    YUYV, which cannot be scaled, is converted to ``bgr8`` for another size. Stamps are those of reading.
    """

    where: ClassVar[str] = "FILE[?topic=/NAME]"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        super().__init__(f"bag:{where}", width, height)
        self._path, key, topic = where.partition(TOPIC_KEY)
        if key and not topic.startswith("/"):
            raise UsageError(f"`source`: 'bag:{where}' should end with the absolute name of a topic, {TOPIC_KEY}/name")
        self._types = get_typestore(Stores.ROS2_JAZZY)  # Humble's images are the same
        self._reader: Any = _open(self._path)
        try:
            self._connection = _connection(self._reader.connections, self._path, topic)
            self._messages: Iterator[tuple[Any, int, bytes]] = self._reader.messages([self._connection])
            self._ahead: Any = self._next()
            self.encoding: Encoding = self._delivered(self._ahead)
            if self.encoding == "yuv422_yuy2":
                check_size(width, height, even=True)
        except BaseException:
            self.close()
            raise

    def _picture(self) -> Pixels:
        message, self._ahead = self._ahead or self._next(), None
        if self._delivered(message) != self.encoding:
            raise SourceError(
                f"`source`: {self.name} changes from {self.encoding} at {self.width}x{self.height} to "
                f"{message.encoding} at {message.width}x{message.height}; a source has one format, cut the recording"
            )
        try:
            return self._pixels(message)
        except ValueError as error:
            raise SourceError(f"`source`: {self._path}: picture {self._index} cannot be read: {error}") from error

    def close(self) -> None:
        if not self._closed:
            with suppress(Exception):  # a damaged file may not even close
                self._reader.close()
        super().close()

    def _next(self) -> Any:
        try:
            entry = next(self._messages, None)
            if entry is None:
                self._messages = self._reader.messages([self._connection])
                entry = next(self._messages, None)
            if entry is not None:
                return self._types.deserialize_cdr(entry[2], self._connection.msgtype)
        except Exception as error:  # rosbags raises any exception on a damaged file
            raise SourceError(f"`source`: {_unreadable(self._path, error)}") from error
        raise SourceError(f"`source`: {self._path} holds no picture on {self._connection.topic}; record some")

    def _delivered(self, message: Any) -> Encoding:
        if not hasattr(message, "encoding"):
            return "bgr8"
        if message.encoding not in CHANNELS:
            raise SourceError(
                f"`source`: {self._path}: {self._connection.topic} has encoding '{message.encoding}', which is "
                f"none of {', '.join(CHANNELS)}"
            )
        if message.encoding == "yuv422_yuy2" and (message.width, message.height) != (self.width, self.height):
            return "bgr8"
        return cast("Encoding", message.encoding)

    def _pixels(self, message: Any) -> Pixels:
        """Return a message's picture as a new array of the source's size; ValueError if it is invalid."""
        if not hasattr(message, "encoding"):
            return resize(bgr_to_rgb(decode_image(message.data)), self.width, self.height)
        channels = CHANNELS[message.encoding]
        if message.step < message.width * channels or message.data.size < message.step * message.height:
            raise ValueError(
                f"{message.width}x{message.height} {message.encoding} in {message.data.size} bytes, step {message.step}"
            )
        rows = message.data[: message.step * message.height].reshape(message.height, message.step)
        shape = (message.height, message.width) if channels == 1 else (message.height, message.width, channels)
        data = cast("Pixels", rows[:, : message.width * channels].reshape(shape))
        if message.encoding != self.encoding:
            data = yuyv_to_bgr(data)
        resized = resize(data, self.width, self.height)
        return resized.copy() if resized.base is not None else resized


def _open(path: str) -> Any:
    if not Path(path).exists():
        raise SourceError(f"`source`: no recording at {path}")
    try:
        _check_metadata(Path(path) / METADATA)
        reader = Reader(path)
        reader.open()
        if not all(isinstance(name, str) for each in reader.connections for name in (each.topic, each.msgtype)):
            raise ValueError("a topic's name or type is no text")
    except Exception as error:  # rosbags raises any exception on a damaged file
        raise SourceError(f"`source`: {_unreadable(path, error)}") from error
    return reader


def _check_metadata(path: Path) -> None:
    """Raise ValueError for a folder's YAML that is invalid, or that could grow without bound when it is read."""
    if not path.is_file():
        return
    if path.stat().st_size > MAX_METADATA_BYTES:
        raise ValueError(f"{METADATA} is larger than {MAX_METADATA_BYTES >> 20} MiB")
    depth = 0
    try:
        for event in YAML(typ="safe", pure=True).parse(path.read_text(encoding="utf-8")):
            where = f"{METADATA}, line {event.start_mark.line + 1}"
            depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise ValueError(f"{where}: deeper than {MAX_DEPTH}")
            if "<<" in (getattr(event, "value", None) or ""):
                raise ValueError(f"{where}: merged keys (<<) are not read")
    except MarkedYAMLError as error:
        where = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ValueError(f"{METADATA}{where}: {error.problem}") from error


def _connection(connections: list[Any], path: str, topic: str) -> Any:
    images = [connection for connection in connections if connection.msgtype in {IMAGE, COMPRESSED_IMAGE}]
    chosen = [connection for connection in images if topic in {"", connection.topic}]
    if chosen:
        return chosen[0]
    names = sorted({connection.topic for connection in images})
    if names:
        raise SourceError(f"`source`: {path} has no image topic {topic}; it has {', '.join(names)}")
    types = sorted({connection.msgtype for connection in connections})
    raise SourceError(
        f"`source`: {path} has no topic of type {IMAGE} or {COMPRESSED_IMAGE}, only {', '.join(types) or 'none at all'}"
    )


def _unreadable(path: str, error: Exception) -> str:
    reason = " ".join(str(error).split()) or type(error).__name__
    reason = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in reason[:MOST_QUOTED])
    return (
        f"{path} is no recording that can be read ({reason}); it should be a rosbag2 folder, "
        "a .mcap or a .db3 file. `mcap recover` repairs an .mcap that was cut short, `ros2 bag reindex` a folder"
    )
