"""Hostile peers of our ROS server: participants of the same domain."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from typing import Any, TypeAlias

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.ros import QoS
from s2a_bench.ros import messages as ros
from s2a_bench.ros.service import READER_QOS, appeared
from s2a_bench.transport import Wiring
from s2a_bench.transport.ros.camera import CAMERA, POLL_S
from s2a_bench.transport.ros.joining import domain_of, join, namespace_of
from s2a_bench.transport.ros.wire import request_message
from s2a_bench.types import Frame, Request
from tests.hostile.suite import Attack, Case
from tests.hostile.tcp import NOISE
from tests.hostile.wires.http import bomb

Messages: TypeAlias = "Callable[[], Iterable[bytes | bytearray]]"
CDR = b"\x00\x01\x00\x00"
MATCHES_S = 10.0
RELIABLE = QoS(depth=0)


def publishes(
    make: Messages, topic: str = "/request", kind: str = ros.REQUEST, *, qos: QoS = RELIABLE, answers: int = 1
) -> Attack:
    """Return a client that publishes messages, and returns the errors of so many ``answers`` on /token."""

    def attack(wiring: Wiring[Any]) -> str:
        errors: list[str] = []
        with closing(join(wiring, "hostile")) as middleware:
            tokens = middleware.subscription(namespace_of(wiring) + "/token", ros.TOKEN, READER_QOS)
            publisher = middleware.publisher(namespace_of(wiring) + topic, kind, qos)
            assert appeared(lambda: bool(publisher.matched() and tokens.matched()), MATCHES_S), "no server to attack"
            for packed in make():
                publisher.send(bytearray(packed))
            deadline = now_ns() + round(MATCHES_S * 1e9)
            while len(errors) < answers and now_ns() < deadline:
                taken = tokens.take(POLL_S)
                if taken is not None and (token := tokens.unpack(taken)).last and token.id != "honest":
                    errors.append(token.error)
        return "\n".join(errors)

    return attack


def _request(images: Iterable[Any] = (), compressed: Iterable[Any] = (), **fields: Any) -> Any:
    request = Request(**{"id": "hostile", "prompt": "go on", "max_tokens": 3, **fields})
    return request_message(request, list(images), list(compressed))


def _asks(images: Iterable[Any] = (), compressed: Iterable[Any] = (), **fields: Any) -> Messages:
    return lambda: [ros.serialise(_request(images, compressed, **fields), ros.REQUEST)]


def image(width: int, height: int, data: int, encoding: str = "rgb8", step: int | None = None) -> Any:
    """Return a picture that says that it has this size, and so many bytes."""
    small = ros.image_message(Frame(0, 0, 1, 1, "rgb8", np.zeros((1, 1, 3), np.uint8)), 1, "camera")
    small.width, small.height, small.encoding = width, height, encoding
    small.step, small.data = width * 3 if step is None else step, np.zeros(data, np.uint8)
    return small


def compressed(data: bytes) -> Any:
    """Return a compressed picture."""
    return ros.compressed_image_message(np.frombuffer(data, np.uint8), 1, "camera", "png")


def _bomb() -> Iterable[bytearray]:
    return [ros.serialise(_request(compressed=[compressed(bomb())]), ros.REQUEST)]


def _altered(at: bytes, by: bytes) -> Messages:
    """Return a request in whose bytes ``at`` is replaced."""
    return lambda: [bytes(ros.serialise(_request(prompt="marker"), ros.REQUEST)).replace(at, by, 1)]


def datagrams(wiring: Wiring[Any]) -> str:
    """Send noise to the UDP ports of the domain's first participants (DDSI-RTPS, 9.6.1)."""
    base = 7400 + 250 * domain_of(wiring)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for port in (base, base + 1, *(base + offset + 2 * index for index in range(4) for offset in (10, 11))):
            for size in (0, 1, 20, 1400, 60_000):
                with suppress(OSError):
                    sender.sendto(NOISE[:size], ("127.0.0.1", port))
                    sender.sendto(b"RTPS\x02\x01" + NOISE[:size], ("127.0.0.1", port))
    return ""


CLIENTS: tuple[Case[Attack], ...] = (
    Case("noise as datagrams", datagrams),
    Case("noise as requests", publishes(lambda: [CDR + NOISE[: 4 * n] for n in range(1, 200)], answers=0)),
    Case("a text of 1 GiB announced", publishes(lambda: [CDR + struct.pack("<I", 1 << 30) + NOISE[:400]], answers=0)),
    Case("2^32-1 pictures announced", publishes(lambda: [CDR + b"\x01\0\0\0\0\0\0\0" * 4 + b"\xff" * 400], answers=0)),
    Case("no UTF-8", publishes(_altered(b"marker", b"\xff\xfe\xc0\xed\xa0\x80"), answers=0)),
    Case("max_tokens 2^32-1", publishes(_asks(max_tokens=(1 << 32) - 1)), "max_tokens should be"),
    Case(
        "8 requests of 16 MiB",
        publishes(lambda: [*_asks(id="flood", prompt="go" + " " * (16 << 20))()] * 8, answers=8),
    ),
    Case("fewer pixels than said", publishes(_asks([image(640, 480, 10)])), "."),
    Case("2^31 x 2^31 pixels", publishes(_asks([image((1 << 31) - 1, (1 << 31) - 1, 12, step=12)])), "at most"),
    Case("an unknown encoding", publishes(_asks([image(2, 2, 12, "bayer_rggb16")])), "bayer_rggb16"),
    Case("a picture of 900 million pixels", publishes(_bomb), "IMAGE_PIXELS"),
    Case("300 requests at once", publishes(lambda: [*_asks(id="flood", max_tokens=50)()] * 300, answers=300)),
    Case("gone in the middle of an answer", publishes(_asks(max_tokens=5000), answers=0)),
    Case("noise as a camera", publishes(lambda: [CDR + NOISE] * 50, CAMERA, ros.IMAGE, qos=QoS(1), answers=0)),
)
"""What our server outlives; both variants' clients are served by one, and read their pictures alike."""
