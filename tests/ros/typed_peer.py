"""A camera in Cyclone DDS' own Python, which knows nothing of s2a-bench: `typed_peer.py DOMAIN TOPIC RELIABILITY`.

Its types have all their fields, as rosbags knows them, and are serialised and described by cyclonedds (XTypes). It
publishes sensor_msgs/Image, 16x12 bgr8 whose every byte is the number of the picture, until its standard input ends.
"""

from __future__ import annotations

import sys
import time
from dataclasses import make_dataclass
from threading import Event, Thread
from typing import Any

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

FIELDS = get_typestore(Stores.ROS2_JAZZY).fielddefs
WIDTH, HEIGHT = 16, 12
RELIABILITY = {"reliable": Policy.Reliability.Reliable(10**9), "best-effort": Policy.Reliability.BestEffort}


def kind(node: Nodetype, detail: Any) -> Any:
    if node == Nodetype.NAME:
        return struct(detail)
    if node == Nodetype.SEQUENCE:
        return types.sequence[kind(*detail[0])]
    return str if detail[0] == "string" else getattr(types, detail[0])


def struct(name: str) -> Any:
    package, _, base = name.split("/")
    made = make_dataclass(base, [(field, kind(*each)) for field, each in FIELDS[name][1]], bases=(IdlStruct,))
    made.__idl__.idl_transformed_typename = f"{package}::msg::dds_::{base}_"
    return made


def main(domain: int, topic: str, reliability: str) -> None:
    image = struct("sensor_msgs/msg/Image")
    header = image.__annotations__["header"]
    stamp = header.__annotations__["stamp"]
    participant = DomainParticipant(domain)
    qos = Qos(RELIABILITY[reliability], Policy.History.KeepLast(1))
    writer = DataWriter(participant, Topic(participant, "rt" + topic, image), qos=qos)
    ended = Event()
    Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    number = 0
    while not ended.wait(0.01):
        number = (number + 1) % 256
        now = stamp(*divmod(time.time_ns(), 10**9))
        pixels = [number] * (3 * WIDTH * HEIGHT)
        writer.write(image(header(now, "camera"), HEIGHT, WIDTH, "bgr8", 0, 3 * WIDTH, pixels))


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
