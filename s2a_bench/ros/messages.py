"""ROS 2 message classes, their CDR, and the frames of this project as ``sensor_msgs`` images.

Types and CDR are rosbags'; this module reads the interface files (.msg, .srv, .action) of ``s2a_msgs``, ``llama_msgs``
and what rosbags lacks of others, adds the types ROS derives from them, and keeps the traps of serialising in one place.

A service gives ``X_Request`` and ``X_Response``; an action gives goal, result and feedback, the two services around
them and the feedback message. Beside each request and response stands ``...__wire``: the body behind the header
``uint64 guid, int64 seq`` with which rmw_cyclonedds sends it. ``X`` and ``X_Event`` are never sent: the hash of a
service, which an RMW may have in its keys, is that of ``X``.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator
from functools import cache, partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any, TypeAlias, get_args

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import MSGParser, make_typesdict

from s2a_bench.errors import TransportError
from s2a_bench.types import Deep, Frame, Pixels

if TYPE_CHECKING:
    if sys.version_info >= (3, 11):
        from importlib.resources.abc import Traversable
    else:
        from importlib.abc import Traversable
    from rosbags.typesys.store import Typestore

Description: TypeAlias = "tuple[Nodetype, Any]"
Fields: TypeAlias = "list[tuple[str, Description]]"
Definition: TypeAlias = "tuple[list[Any], Fields]"
"""Constants and fields of a type, what rosbags' type store registers."""
Defaults: TypeAlias = "dict[str, dict[str, Any]]"
"""ROS type name -> field -> the default its interface file gives."""

SECTION_ENDS = re.compile(r"^[ \t]*---[ \t]*$", re.MULTILINE)
PARTS = {
    "msg": ("",),
    "srv": ("_Request", "_Response"),
    "action": ("_Goal", "_Result", "_Feedback"),
}
"""Kind of interface file -> the suffixes of the types between its ``---`` lines."""

CDR_HEADER = 4
REQUEST = "s2a_msgs/msg/Request"
TOKEN = "s2a_msgs/msg/Token"  # noqa: S105 - a type name
ACTIONS = "s2a_msgs/msg/Actions"
MARKS = "s2a_msgs/msg/Marks"
PROVENANCE = "s2a_msgs/msg/Provenance"
IMAGE = "sensor_msgs/msg/Image"
CLOCK = "rosgraph_msgs/msg/Clock"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

CHANNELS: dict[str, int] = {
    **dict.fromkeys(("bgr8", "rgb8"), 3),
    **dict.fromkeys(("bgra8", "rgba8"), 4),
    **dict.fromkeys(("bgr16", "rgb16"), 6),
    **dict.fromkeys(("yuv422_yuy2", "yuv422", "mono16"), 2),
    **dict.fromkeys(("mono8", "nv12", "nv21", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), 1),
}
"""Bytes per pixel of the raw encodings (``sensor_msgs/image_encodings.hpp``); of NV12 and NV21 those of brightness."""
ALSO = {"yuyv": "yuv422_yuy2", "uyvy": "yuv422", "8UC3": "bgr8", "8UC1": "mono8"}
"""Second names since ROS 2 Iron, and OpenCV's types, whose order of colours is blue first."""
CHROMA_BELOW = frozenset({"nv12", "nv21"})
"""Encodings with half as many rows of colour below those of brightness."""
DEPTH = frozenset({"16UC1", "32FC1"})
"""Encodings of distances (REP 118)."""

VERSIONS = {"6.0": "llama_msgs-6.0.9", "4.4": "llama_msgs-4.4.1"}
"""Version of llama_msgs -> its folder in ``interfaces``; one type store knows one version."""
DEFAULT_VERSION = "6.0"
SHOWN = 64
"""Letters of an encoding that came from outside, in an error: the log keeps its kinds."""
ZEROS: dict[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
"""The zero of each basic type that is not an integer."""


def read_package(folder: Traversable, package: str) -> tuple[dict[str, Definition], Defaults]:
    """Read ``folder/{msg,srv,action}/*`` as the interfaces of ``package``."""
    definitions: dict[str, Definition] = {}
    defaults: Defaults = {}
    for kind, suffixes in PARTS.items():
        if not (folder / kind).is_dir():
            continue
        for entry in sorted((folder / kind).iterdir(), key=lambda entry: entry.name):
            if not entry.name.endswith("." + kind):
                continue
            name = f"{package}/{kind}/{entry.name.removesuffix('.' + kind)}"
            for suffix, text in zip(suffixes, SECTION_ENDS.split(entry.read_text()), strict=True):
                definitions[name + suffix], defaults[name + suffix] = _parse(text, package)
            definitions.update(_derived(name, kind))
    return definitions, defaults


def _parse(text: str, package: str) -> tuple[Definition, dict[str, Any]]:
    """Parse one section; under ``msg/``, because rosbags resolves bare names beside the type's own."""
    (parsed,) = MSGParser(f"MSG: {package}/msg/Section\n{text}").specification()
    (definition,) = make_typesdict([parsed]).values()
    return definition, {field.name: field.value for field in parsed.fields if field.value is not None}


def _derived(name: str, kind: str) -> Iterator[tuple[str, Definition]]:
    services = [name] if kind == "srv" else []
    if kind == "action":
        services = [name + "_SendGoal", name + "_GetResult"]
        goal_id = "unique_identifier_msgs/msg/UUID"
        yield name + "_SendGoal_Request", _definition(goal_id=goal_id, goal=name + "_Goal")
        yield name + "_SendGoal_Response", _definition(accepted="bool", stamp="builtin_interfaces/msg/Time")
        yield name + "_GetResult_Request", _definition(goal_id=goal_id)
        yield name + "_GetResult_Response", _definition(status="int8", result=name + "_Result")
        yield name + "_FeedbackMessage", _definition(goal_id=goal_id, feedback=name + "_Feedback")
    for service in services:
        request, response, event = (service + part for part in ("_Request", "_Response", "_Event"))
        for half in (request, response):
            yield half + "__wire", _definition(guid="uint64", seq="int64", body=half)
        _, info = _definition(info="service_msgs/msg/ServiceEventInfo")
        at_most_one = [(Nodetype.SEQUENCE, ((Nodetype.NAME, half), 1)) for half in (request, response)]
        yield event, ([], [*info, ("request", at_most_one[0]), ("response", at_most_one[1])])
        yield service, _definition(request_message=request, response_message=response, event_message=event)


def _definition(**kinds: str) -> Definition:
    fields = kinds.items()
    return [], [(name, (Nodetype.NAME, kind) if "/" in kind else (Nodetype.BASE, (kind, 0))) for name, kind in fields]


def char_as_uint8(description: Description) -> Description:
    """Replace ``char`` by the ``uint8`` that ROS 2 takes it for, in type hashes too."""
    node, detail = description
    if node == Nodetype.BASE:
        return (node, ("uint8", 0)) if detail[0] == "char" else description
    if node == Nodetype.NAME:
        return description
    inner, count = detail
    return (node, (char_as_uint8(inner), count))


@cache
def _types(version: str) -> tuple[Typestore, Defaults]:
    humble = os.environ.get("ROS_DISTRO") == "humble"
    store = get_typestore(Stores.ROS2_HUMBLE if humble else Stores.ROS2_JAZZY)
    for name, (constants, fields) in store.fielddefs.items():
        store.fielddefs[name] = (constants, [(field, char_as_uint8(kind)) for field, kind in fields])
    root = files("s2a_bench.ros")
    folders = {each.name: each for each in (root / "interfaces").iterdir() if not each.name.startswith("llama_msgs")}
    folders |= {"s2a_msgs": root / "s2a_msgs", "llama_msgs": root / "interfaces" / VERSIONS[version]}
    defaults: Defaults = {}
    for package, folder in folders.items():
        definitions, package_defaults = read_package(folder, package)
        store.register(definitions)
        defaults |= package_defaults
    return store, defaults


def typestore(version: str = DEFAULT_VERSION) -> Typestore:
    """Return the message types of this ROS distribution (Jazzy without one), ours and one of `VERSIONS` included."""
    return _types(version)[0]


def message(type_name: str, /, **fields: Any) -> Any:
    """Build a message of the default version; every field must be given: `default` fills them."""
    return typestore().types[type_name](**fields)


def default(type_name: str, version: str = DEFAULT_VERSION, /, **fields: Any) -> Any:
    """Build a message as ROS initialises it, the defaults of its interface file or zeros; ``fields`` replace them."""
    store, defaults = _types(version)
    values = defaults.get(type_name, {}) | fields
    for name, description in store.fielddefs[type_name][1]:
        if name not in values:
            values[name] = _zero(description, version)
        elif isinstance(values[name], Iterable) and not isinstance(values[name], str):
            values[name] = _sequence(description, values[name])
    return store.types[type_name](**values)


def _zero(description: Any, version: str) -> Any:
    node, detail = description
    if node == Nodetype.BASE:
        return ZEROS.get(detail[0], 0)
    if node == Nodetype.NAME:
        return default(detail, version)
    inner, count = detail
    length = count if node == Nodetype.ARRAY else 0
    return _sequence(description, [_zero(inner, version) for _ in range(length)])


def _sequence(description: Any, values: Iterable[Any]) -> Any:
    """Return a sequence as rosbags wants it: an array of numbers, a list of anything else."""
    inner = description[1][0]
    if inner[0] == Nodetype.NAME or inner[1][0] == "string":
        return list(values)
    return np.asarray(values, {"byte": "uint8"}.get(inner[1][0], inner[1][0]))


def version_of(type_name: str, announced: str) -> str | None:
    """Return the version of llama_msgs in which a type has the hash that a peer announces; None for no such one."""
    return next((version for version in VERSIONS if announced == type_hash(type_name, version)), None)


def dds_type_name(type_name: str) -> str:
    """Turn ``pkg/msg/Name`` into ROS 2's DDS type name ``pkg::msg::dds_::Name_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type_name(type_name: str) -> str:
    """Turn ``pkg::msg::dds_::Name_`` into ``pkg/msg/Name``."""
    return type_name.replace("::dds_::", "/").replace("::", "/").removesuffix("_")


@cache
def type_hash(type_name: str, version: str = DEFAULT_VERSION) -> str:
    """Return the type's REP-2016 hash, ``RIHS01_`` and 64 hex digits."""
    return str(typestore(version).hash_rihs01(type_name))


def serialise(value: Any, type_name: str, version: str = DEFAULT_VERSION, *, padded: bool = True) -> bytearray:
    """Write a message as little-endian CDR (XCDR1), ``padded`` to a multiple of 4 as Cyclone DDS sends it.

    The buffer is zeroed first because rosbags skips NULs and padding. Header ``00 01 00 pp``, pp = bytes of padding.
    """
    store = typestore(version)
    size = serialised_bytes(value, type_name, version)
    padding = -size % 4 if padded else 0
    buffer = bytearray(size + padding)
    buffer[1], buffer[3] = 1, padding  # ROS ignores the count of padding; Cyclone writes it
    store.get_msgdef(type_name).serialize_cdr_le(memoryview(buffer)[CDR_HEADER:], 0, value, store)
    return buffer


def serialised_bytes(value: Any, type_name: str, version: str = DEFAULT_VERSION) -> int:
    """Return how many bytes `serialise` would write, padding left out."""
    store = typestore(version)
    return CDR_HEADER + int(store.get_msgdef(type_name).getsize_cdr(0, value, store))


def deserialise(cdr: memoryview, type_name: str, version: str = DEFAULT_VERSION) -> Any:
    """Read a message from CDR; arrays are views of ``cdr``. Raises TransportError for what is not that type."""
    try:
        return typestore(version).deserialize_cdr(cdr, type_name)
    except Exception as error:  # rosbags' generated code raises whatever its parsing runs into
        raise TransportError(f"received bytes that are not a {type_name}: {error}") from error


int64_array = partial(np.fromiter, dtype=np.int64)
float64_array = partial(np.fromiter, dtype=np.float64)
float32_array = partial(np.fromiter, dtype=np.float32)
"""Make what rosbags wants for an array field of that type."""


def uuid(goal_id: bytes) -> Any:
    return message("unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(goal_id, np.uint8))


def stamp(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def header(stamp_ns: int, frame_id: str = "") -> Any:
    return message("std_msgs/msg/Header", stamp=stamp(stamp_ns), frame_id=frame_id)


def image_message(frame: Frame, stamp_ns: int, frame_id: str) -> Any:
    """Wrap a raw frame as sensor_msgs/Image, without copying pixels; ``stamp_ns`` is ROS time."""
    return message(
        IMAGE,
        header=header(stamp_ns, frame_id),
        height=frame.height,
        width=frame.width,
        encoding=frame.encoding,
        is_bigendian=int(sys.byteorder == "big"),
        step=frame.width * CHANNELS[frame.encoding],
        data=frame.data.reshape(-1),
    )


def compressed_image_message(data: Pixels, stamp_ns: int, frame_id: str, coding: str = "jpeg") -> Any:
    """Wrap a JPEG or PNG as sensor_msgs/CompressedImage, its format in the words of compressed_image_transport."""
    format_ = f"bgr8; {coding} compressed bgr8"
    return message(COMPRESSED_IMAGE, header=header(stamp_ns, frame_id), format=format_, data=data)


def frame_of_image(image: Any, index: int = -1) -> Frame:
    """Unwrap a sensor_msgs/Image; the pixels stay a view of the message. Raises TransportError."""
    encoding = ALSO.get(image.encoding, image.encoding)
    refuse_depth(encoding)
    channels = CHANNELS.get(encoding)
    if channels is None:
        raise TransportError(f"image encoding '{encoding[:SHOWN]}' is not one of {', '.join(CHANNELS)}")
    if not (image.width and image.height):
        raise TransportError(f"image of {image.width}x{image.height} {image.encoding[:SHOWN]} is empty")
    height = image.height * 3 // 2 if encoding in CHROMA_BELOW else image.height
    if image.step < image.width * channels or image.data.size < image.step * height:
        raise TransportError(
            f"image of {image.width}x{image.height} {image.encoding[:SHOWN]} has {image.data.size} bytes"
        )
    rows = image.data[: image.step * height].reshape(height, image.step)[:, : image.width * channels]
    pixels = rows.reshape((height, image.width) if channels == 1 else (height, image.width, channels))
    if encoding in get_args(Deep) and bool(image.is_bigendian) != (sys.byteorder == "big"):
        pixels = pixels.reshape(*pixels.shape[:2], -1, 2)[..., ::-1].reshape(pixels.shape)
    return Frame(index, nanoseconds(image.header.stamp), image.width, image.height, encoding, pixels)


def refuse_depth(encoding: str) -> None:
    if encoding in DEPTH:
        raise TransportError(
            f"image encoding '{encoding}' is depth, which a model cannot look at: give it the camera's colour topic"
        )


def nanoseconds(time: Any) -> int:
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)
