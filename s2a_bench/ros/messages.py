"""ROS 2 message classes, their CDR, and the frames of this project as ``sensor_msgs`` images.

Types and CDR are rosbags'; this module registers ``s2a_msgs`` and keeps the traps of serialising in one place.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from s2a_bench.errors import TransportError
from s2a_bench.types import Frame, Pixels

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

CDR_HEADER = 4
REQUEST = "s2a_msgs/msg/Request"
TOKEN = "s2a_msgs/msg/Token"  # noqa: S105 - a type name
MARKS = "s2a_msgs/msg/Marks"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

CHANNELS: dict[str, int] = {"yuv422_yuy2": 2, "bgr8": 3, "rgb8": 3, "mono8": 1}
"""Bytes per pixel of the raw encodings (``sensor_msgs/image_encodings.hpp``)."""


@cache
def typestore() -> Typestore:
    """Return the message types of this ROS distribution (Jazzy without one), ``s2a_msgs`` included."""
    humble = os.environ.get("ROS_DISTRO") == "humble"
    store = get_typestore(Stores.ROS2_HUMBLE if humble else Stores.ROS2_JAZZY)
    folder = files("s2a_bench.ros") / "s2a_msgs" / "msg"
    types = {}
    for entry in folder.iterdir():
        if entry.name.endswith(".msg"):
            types.update(get_types_from_msg(entry.read_text(), f"s2a_msgs/msg/{entry.name.removesuffix('.msg')}"))
    store.register(types)
    return store


def message(type_name: str, **fields: Any) -> Any:
    """Build a message; every field must be given, because rosbags has no defaults."""
    return typestore().types[type_name](**fields)


@cache
def type_hash(type_name: str) -> str:
    """Return the type's REP-2016 hash, ``RIHS01_`` and 64 hex digits."""
    return str(typestore().hash_rihs01(type_name))


def serialise(value: Any, type_name: str) -> bytearray:
    """Write a message as little-endian CDR (XCDR1), padded to a multiple of 4 as Cyclone DDS sends it.

    The buffer is zeroed first because rosbags skips NULs and padding. Header ``00 01 00 pp``, pp = bytes of padding.
    """
    store = typestore()
    definition = store.get_msgdef(type_name)
    size = CDR_HEADER + definition.getsize_cdr(0, value, store)
    padding = -size % 4
    buffer = bytearray(size + padding)
    buffer[1], buffer[3] = 1, padding
    definition.serialize_cdr_le(memoryview(buffer)[CDR_HEADER:], 0, value, store)
    return buffer


def deserialise(cdr: memoryview, type_name: str) -> Any:
    """Read a message from CDR; arrays are views of ``cdr``. Raises TransportError for what is not that type."""
    try:
        return typestore().deserialize_cdr(cdr, type_name)
    except Exception as error:  # rosbags' generated code raises whatever its parsing runs into
        raise TransportError(f"received bytes that are no {type_name}: {error}") from error


def int64_array(values: Iterable[int]) -> NDArray[Any]:
    """Make what rosbags wants for an ``int64[]`` field."""
    return np.fromiter(values, np.int64)


def float64_array(values: Iterable[float]) -> NDArray[Any]:
    """Make what rosbags wants for a ``float64[]`` field."""
    return np.fromiter(values, np.float64)


def _header(stamp_ns: int, frame_id: str) -> Any:
    """Build a std_msgs/Header."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def image_message(frame: Frame, stamp_ns: int, frame_id: str) -> Any:
    """Wrap a raw frame as sensor_msgs/Image, without copying pixels; ``stamp_ns`` is ROS time."""
    return message(
        IMAGE,
        header=_header(stamp_ns, frame_id),
        height=frame.height,
        width=frame.width,
        encoding=frame.encoding,
        is_bigendian=int(sys.byteorder == "big"),
        step=frame.width * CHANNELS[frame.encoding],
        data=frame.data.reshape(-1),
    )


def compressed_image_message(data: Pixels, stamp_ns: int, frame_id: str) -> Any:
    """Wrap a JPEG as sensor_msgs/CompressedImage."""
    return message(COMPRESSED_IMAGE, header=_header(stamp_ns, frame_id), format="bgr8; jpeg compressed bgr8", data=data)


def frame_of_image(image: Any, index: int = -1) -> Frame:
    """Unwrap a sensor_msgs/Image; the pixels stay a view of the message. Raises TransportError."""
    channels = CHANNELS.get(image.encoding)
    if channels is None:
        raise TransportError(f"image encoding '{image.encoding}' is none of {', '.join(CHANNELS)}")
    if image.step < image.width * channels or image.data.size < image.step * image.height:
        raise TransportError(f"image of {image.width}x{image.height} {image.encoding} has {image.data.size} bytes")
    rows = image.data[: image.step * image.height].reshape(image.height, image.step)[:, : image.width * channels]
    shape = (image.height, image.width) if channels == 1 else (image.height, image.width, channels)
    return Frame(index, stamp_of(image.header), image.width, image.height, image.encoding, rows.reshape(shape))


def stamp_of(header: Any) -> int:
    """Return a header's stamp in ns of ROS time."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
