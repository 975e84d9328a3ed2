"""Frames of a ROS 2 recording (rosbag2 folder, ``.mcap`` or ``.db3`` file), in a loop."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

from rosbags.rosbag2 import Reader

from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames.messages import TYPES, ImageMessages
from s2a_bench.ros.messages import typestore
from s2a_bench.text import read_text
from s2a_bench.types import Pixels

TOPIC_KEY = "?topic="
MOST_QUOTED = 300
"""Characters that are quoted of a library's error about a damaged file."""


class Recording(ImageMessages):
    """A recorded image topic as a camera; stamps are those of reading."""

    where: ClassVar[str] = "FILE[?topic=/NAME]"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        super().__init__(f"bag:{where}", width, height)
        self._path, key, topic = where.partition(TOPIC_KEY)
        if key and not topic.startswith("/"):
            raise UsageError(f"`source`: 'bag:{where}' should end with the absolute name of a topic, {TOPIC_KEY}/name")
        self._reader: Any = open_recording(self._path)
        try:
            self._connection = _connection(self._reader.connections, self._path, topic)
            self._messages: Iterator[tuple[Any, int, bytes]] = self._reader.messages([self._connection])
            self._ahead: Any = self._next()
            self.begin(self._ahead)
        except BaseException:
            self.close()
            raise

    def _picture(self) -> Pixels:
        message, self._ahead = self._ahead or self._next(), None
        return self.pixels(message)

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
                return typestore().deserialize_cdr(entry[2], self._connection.msgtype)
        except Exception as error:  # rosbags raises any exception on a damaged file
            raise unreadable(self._path, error) from error
        raise SourceError(f"`source`: {self._path} holds no picture on {self._connection.topic}; record some")


def open_recording(path: str, option: str = "source") -> Any:
    """Return an open reader of rosbags; raises SourceError, naming the option, for anything but a recording."""
    if not Path(path).exists():
        raise SourceError(f"`{option}`: no recording at {path}")
    try:
        metadata = Path(path) / "metadata.yaml"
        if metadata.is_file() and re.search("<<|!!|!<|%TAG", read_text(metadata)):
            raise ValueError("metadata.yaml: merged keys (<<) and tags are not read: a few could take endless time")
        reader = Reader(path)
        reader.open()
        if not all(isinstance(name, str) for each in reader.connections for name in (each.topic, each.msgtype)):
            raise ValueError("a topic's name or type is not text")
    except Exception as error:  # rosbags raises any exception on a damaged file
        raise unreadable(path, error, option) from error
    return reader


def _connection(connections: list[Any], path: str, topic: str) -> Any:
    images = [connection for connection in connections if connection.msgtype in TYPES]
    matches = [connection for connection in images if topic in {"", connection.topic}]
    if matches:
        return matches[0]
    names = sorted({connection.topic for connection in images})
    if names:
        raise SourceError(f"`source`: {path} has no image topic {topic}; it has {', '.join(names)}")
    types = sorted({connection.msgtype for connection in connections})
    raise SourceError(
        f"`source`: {path} has no topic of type {' or '.join(TYPES)}, only {', '.join(types) or 'none at all'}"
    )


def unreadable(path: str, error: Exception, option: str = "source") -> SourceError:
    reason = " ".join(str(error).split())[:MOST_QUOTED] or type(error).__name__
    return SourceError(
        f"`{option}`: {path} is not a recording that can be read ({reason}); it should be a rosbag2 folder, "
        "a .mcap or a .db3 file. `mcap recover` repairs an .mcap that was cut short, `ros2 bag reindex` a folder"
    )
