"""Recordings of ROS 2 as a lab makes them: a camera, and the tokens that answer its pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from s2a_bench.ros import messages as ros
from s2a_bench.types import Frame

MS = 1_000_000
T0_NS = 1_700_000_000_000_000_000
CAMERA, TOKENS = "/camera/image_raw", "/llama/token"
STRING = "std_msgs/msg/String"
POSE = "geometry_msgs/msg/PoseStamped"


def image(stamp_ns: int, width: int = 64, height: int = 48) -> Any:
    frame = Frame(0, 0, width, height, "rgb8", np.full((height, width, 3), 9, np.uint8))
    return ros.image_message(frame, stamp_ns, "camera")


def string(text: str) -> Any:
    return ros.message(STRING, data=text)


def pose(stamp_ns: int) -> Any:
    return ros.default(POSE, header=ros.header(stamp_ns))


def record(path: Path, messages: list[tuple[int, str, Any]], plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Write a recording of (ms, topic, message)."""
    types = get_typestore(Stores.ROS2_JAZZY)
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for at_ms, topic, message in messages:
            type_name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=types)
            writer.write(connections[topic], T0_NS + at_ms * MS, types.serialize_cdr(message, type_name))
    return path


def tokens() -> list[tuple[int, str, Any]]:
    """Two observations, the first with three tokens, the second with one; another topic, and a frame without answer."""
    return [
        (0, "/other", string("x")),
        (5, TOKENS, string("early")),
        (100, CAMERA, image(1)),
        (150, TOKENS, string("a")),
        (160, TOKENS, string("b")),
        (180, TOKENS, string("c")),
        (300, CAMERA, image(2)),
        (400, CAMERA, image(3)),
        (425, TOKENS, string("abc")),
    ]
