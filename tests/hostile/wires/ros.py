"""Hostile participants of our ROS server's domain."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Any

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.service import READER_QOS, appeared
from s2a_bench.transport import Wiring
from s2a_bench.transport.ros.camera import CAMERA, POLL_S
from s2a_bench.transport.ros.joining import join, namespace_of
from s2a_bench.transport.ros.wire import request_message
from s2a_bench.types import Frame, Request
from tests.hostile.peers import LEFT, NOISE, PATIENCE_S, Attack, Case
from tests.hostile.wires.http import bomb

RELIABLE = QoS(depth=0)
QUIET_NS = 3_000_000_000
CDR = b"\x00\x01\x00\x00"


def publishes(
    make: Callable[[], Iterable[bytes | bytearray]],
    topic: str = "/request",
    kind: str = ros.REQUEST,
    *,
    qos: QoS = RELIABLE,
    answers: int = 0,
) -> Attack:
    """Return a client that publishes messages, and returns the errors of at most so many ``answers`` on /token."""

    def attack(wiring: Wiring[Any], says: str) -> str:
        del says
        errors: list[str] = []
        with closing(join(wiring, "hostile")) as middleware:
            tokens = middleware.subscription(namespace_of(wiring) + "/token", ros.TOKEN, READER_QOS)
            publisher = middleware.publisher(namespace_of(wiring) + topic, kind, qos)
            assert appeared(lambda: bool(publisher.matched() and tokens.matched()), PATIENCE_S), "no server to attack"
            for packed in make():
                publisher.send(bytearray(packed))
            deadline = now_ns() + round(PATIENCE_S * 1e9)
            while len(errors) < answers and now_ns() < deadline:
                taken = tokens.take(POLL_S)
                if taken is not None and (token := tokens.unpack(taken)).last and token.id == "hostile":
                    errors.append(token.error)
                    deadline = now_ns() + QUIET_NS  # messages may be lost
        return f"{len(errors)} answers: {' '.join(errors)}" if answers else LEFT

    return attack


def asks(
    images: Iterable[Any] = (), compressed: Iterable[Any] = (), **fields: Any
) -> Callable[[], Iterable[bytes | bytearray]]:
    def make() -> Iterable[bytes | bytearray]:
        request = Request(**{"id": "hostile", "prompt": "go on", "max_tokens": 3, **fields})
        return [ros.serialise(request_message(request, list(images), list(compressed)), ros.REQUEST)]

    return make


def image(width: int, height: int, data: int, encoding: str = "rgb8", step: int | None = None) -> Any:
    """Return a picture that says that it has this size, and so many bytes."""
    small = ros.image_message(Frame(0, 0, 1, 1, "rgb8", np.zeros((1, 1, 3), np.uint8)), 1, "camera")
    small.width, small.height, small.encoding = width, height, encoding
    small.step, small.data = width * 3 if step is None else step, np.zeros(data, np.uint8)
    return small


def no_utf_8() -> Iterable[bytes]:
    return [bytes(packed).replace(b"marker", b"\xff\xfe\xc0\xed\xa0\x80", 1) for packed in asks(prompt="marker")()]


def bombed() -> Iterable[bytes | bytearray]:
    return asks(compressed=[ros.compressed_image_message(np.frombuffer(bomb(), np.uint8), 1, "camera", "png")])()


CLIENTS = (
    Case("noise", publishes(lambda: [CDR + NOISE[: 4 * n] for n in range(1, 200)])),
    Case("noise as a camera", publishes(lambda: [CDR + NOISE] * 50, CAMERA, ros.IMAGE, qos=QoS(1))),
    Case("no UTF-8", publishes(no_utf_8)),
    Case("max_tokens 2^32-1", publishes(asks(max_tokens=(1 << 32) - 1), answers=1), "max_tokens should be"),
    Case("fewer pixels than said", publishes(asks([image(640, 480, 10)]), answers=1), "1 answers: ."),
    Case("an unknown encoding", publishes(asks([image(2, 2, 12, "bayer_rggb16")]), answers=1), "bayer_rggb16"),
    Case("gone in the middle of an answer", publishes(asks(max_tokens=5000))),
)
LARGE = (
    Case("a text of 1 GiB announced", publishes(lambda: [CDR + struct.pack("<I", 1 << 30) + NOISE[:400]])),
    Case("2^32-1 pictures announced", publishes(lambda: [CDR + b"\x01\0\0\0\0\0\0\0" * 4 + b"\xff" * 400])),
    Case("2^31 x 2^31 pixels", publishes(asks([image((1 << 31) - 1, (1 << 31) - 1, 12, step=12)]), answers=1), "."),
    Case("a picture of 900 million pixels", publishes(bombed, answers=1), "1 answers: ."),
    Case("300 requests at once", publishes(lambda: [*asks(max_tokens=50)()] * 300, answers=300), r"^[1-9]\d* answers"),
)
