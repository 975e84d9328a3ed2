"""A node of zenoh-ros2-sdk, which speaks rmw_zenoh by its own work: `zenoh_peer.py PORT FOLDER ROLE NAME`.

It knows the message definitions of FOLDER, and hashes them itself. What it meets goes to standard output as lines of
JSON; it ends with its standard input.
"""

from __future__ import annotations

import hashlib
import json
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/msg/String": "string data\n",
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data\n",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types\n",
}
GET_TYPES = "rcl_interfaces/srv/GetParameterTypes"
SAID = {"says": "std_msgs/msg/String", "films": "sensor_msgs/msg/Image"}


def write_definitions(folder: Path) -> None:
    """Write what the node is to know."""
    for name, text in DEFINITIONS.items():
        package, kind, base = name.split("/")
        path = folder / package / kind / f"{base}.{kind}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def tell(**what: Any) -> None:
    print(json.dumps(what), flush=True)  # noqa: T201 - how it talks to the test


def said(role: str, number: int, type_of: Any) -> dict[str, Any]:
    """Return the fields of what is published: a text, or a picture of 16x12 that is its number all over."""
    if role == "says":
        return {"data": f"say {number}"}
    stamp = type_of("builtin_interfaces/msg/Time")(sec=1, nanosec=2)
    header = type_of("std_msgs/msg/Header")(stamp=stamp, frame_id="camera")
    shape = {"height": 12, "width": 16, "encoding": "rgb8", "is_bigendian": 0, "step": 48}
    return {"header": header, "data": np.full(16 * 12 * 3, number % 256, np.uint8), **shape}


def main(port: int, folder: str, role: str, name: str) -> None:
    from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber
    from zenoh_ros2_sdk.message_registry import get_registry
    from zenoh_ros2_sdk.session import ZenohSession

    session = ZenohSession.get_instance("127.0.0.1", port)
    known = get_registry(folder)
    known.load_service_type(GET_TYPES)
    ended = threading.Event()
    where = {"domain_id": 0, "router_port": port, "node_name": "peer"}

    def image(message: Any) -> None:
        sha = hashlib.sha256(message.data.tobytes()).hexdigest()
        tell(size=[message.width, message.height], encoding=message.encoding, sha=sha)

    def types(request: Any) -> Any:
        return server.response_msg_class(types=np.array([len(each) for each in request.names], np.uint8))

    if role in SAID:
        ends: Any = ROS2Publisher(name, SAID[role], **where)
    elif role == "sees":
        ends = ROS2Subscriber(name, "sensor_msgs/msg/Image", image, **where)
    elif role == "hears":
        ends = ROS2Subscriber(name, "std_msgs/msg/String", lambda message: tell(data=message.data), **where)
    elif role == "asks":
        ends = ROS2ServiceClient(name, GET_TYPES, **where)
    else:
        ends = server = ROS2ServiceServer(name, GET_TYPES, types, **where)
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    tell(ready=role)
    if role == "asks":
        answer = ends.call(names=["a", "four"])
        tell(types=answer and [int(each) for each in answer.types])
    number = 0
    while not ended.wait(0.05):
        if role in SAID:
            ends.publish(**said(role, number, known.get_message_class))
        number += 1
    ends.close()
    session.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
