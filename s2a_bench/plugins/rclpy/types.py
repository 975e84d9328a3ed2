"""Message classes of the ROS 2 workspace, and the way between them and the rosbags classes: CDR.

Both sides read and write CDR, so nothing is converted field by field here: rclpy's own serialiser, which is C, fills
the generated classes, and rosbags gives views of bytes. Pixels go beside the CDR: into an ``array.array('B')``, which
generated classes take as it is, by one copy, and out of it by none.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Nodetype

from s2a_bench.errors import MissingInterface
from s2a_bench.ros import messages as ros
from s2a_bench.ros.llama import images_of


def interface_class(type_name: str) -> Any:
    """Return the generated class of ``pkg/msg/Name`` or ``pkg/action/Name``; raises MissingInterface without it."""
    package, kind, name = type_name.split("/")
    try:
        return getattr(import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError) as error:
        raise MissingInterface(
            f"{type_name} is not in this ROS 2 workspace ({error}): build its package with "
            f"`colcon build --packages-select {package}` and source install/setup.bash, or use middleware cyclonedds"
        ) from error


def to_ros(message: Any, cls: Any, type_name: str, version: str) -> Any:
    with _without_pixels(message, np.empty(0, np.uint8)) as pixels:
        converted = deserialize_message(bytes(ros.serialise(message, type_name, version)), cls)
    for image, its in zip(images_of(converted), pixels, strict=True):
        data = array("B")
        data.frombytes(np.ascontiguousarray(its).data.cast("B"))
        image.data = data
    return converted


def from_ros(message: Any, type_name: str, version: str) -> Any:
    """Turn a message of a generated class into a rosbags message, whose arrays are views of its CDR or pixels."""
    with _without_pixels(message, array("B")) as pixels:
        converted = ros.deserialise(memoryview(serialize_message(message)), type_name, version)
    for image, its in zip(images_of(converted), pixels, strict=True):
        image.data = np.frombuffer(its, np.uint8)
    return converted


@contextmanager
def _without_pixels(message: Any, none: Any) -> Iterator[list[Any]]:
    """Give out the pixels of a message's images, which has ``none`` meanwhile."""
    images = images_of(message)
    pixels = [image.data for image in images]
    try:
        for image in images:
            image.data = none
        yield pixels
    finally:
        for image, its in zip(images, pixels, strict=True):
            image.data = its


def fits(cls: Any, type_name: str, version: str = ros.DEFAULT_VERSION) -> bool:
    """Return whether a generated class has our fields in our order, down to the last nested one.

    Bytes cannot tell: serialisers of ROS leave the padding as they found it.
    """
    fields = ros.typestore(version).fielddefs[type_name][1]
    if list(cls.get_fields_and_field_types()) != [name for name, _ in fields]:
        return False
    inner = (detail if node in {Nodetype.BASE, Nodetype.NAME} else detail[0] for _, (node, detail) in fields)
    nested = {name for name in map(_type_name, inner) if name}
    return all(fits(interface_class(name), name, version) for name in nested)


def _type_name(detail: Any) -> str:
    """Return the message type in a field's description, "" for a basic type."""
    if isinstance(detail, str):
        return detail
    return str(detail[1]) if detail[0] == Nodetype.NAME else ""


def message_class(type_name: str) -> Any:
    """Return a message's generated class; raises MissingInterface for none, or one of another layout than ours."""
    cls = interface_class(type_name)
    if not fits(cls, type_name):
        package = type_name.split("/", maxsplit=1)[0]
        raise MissingInterface(
            f"{type_name} of this ROS 2 workspace has other fields than ours: rebuild it with "
            f"`colcon build --packages-select {package}`"
        )
    return cls


def installed_version(action: Any, type_name: str) -> str:
    """Return the version of llama_msgs that the workspace has; raises MissingInterface for an unknown one."""
    for version in ros.VERSIONS:
        if fits(action.Goal, type_name + "_Goal", version):
            return version
    raise MissingInterface(f"{type_name} of this ROS 2 workspace is not one of llama_msgs {', '.join(ros.VERSIONS)}")


def has_action(type_name: str) -> bool:
    try:
        return bool(installed_version(interface_class(type_name), type_name))
    except MissingInterface:
        return False
