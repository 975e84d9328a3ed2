"""ROS 2 messages: types, hashes, CDR, and frames as images."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import TransportError
from s2a_bench.ros import messages as ros
from s2a_bench.types import Frame


def request(**fields: Any) -> Any:
    whole = {"id": "a", "prompt": "p", "max_tokens": 1, "state": ros.float32_array([0.5, -2.0])}
    return ros.default(ros.REQUEST, "6.0", **(whole | fields))


def test_cdr_of_a_string_message_by_hand() -> None:
    cdr = ros.serialise(ros.message("std_msgs/msg/String", data="hey"), "std_msgs/msg/String")
    assert cdr.hex() == "00010000" + "04000000" + b"hey\0".hex()


def test_cdr_is_padded_to_four_and_says_by_how_much() -> None:
    cdr = ros.serialise(ros.message("std_msgs/msg/String", data="hello"), "std_msgs/msg/String")
    assert cdr.hex() == "00010002" + "06000000" + b"hello\0".hex() + "0000"


def test_received_pixels_are_a_view_not_a_copy() -> None:
    frame = Frame(0, 0, 4, 2, "rgb8", np.zeros((2, 4, 3), np.uint8))
    cdr = ros.serialise(request(images=[ros.image_message(frame, 0, "c")]), ros.REQUEST)
    image = ros.frame_of_image(ros.deserialise(memoryview(cdr), ros.REQUEST).images[0])
    assert np.shares_memory(image.data, np.frombuffer(cdr, np.uint8))


@pytest.mark.parametrize("cdr", [b"", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\x7f", bytes(64)])
def test_foreign_bytes_are_refused(cdr: bytes) -> None:
    with pytest.raises(TransportError, match="not a s2a_msgs/msg/Request"):
        ros.deserialise(memoryview(cdr), ros.REQUEST)
