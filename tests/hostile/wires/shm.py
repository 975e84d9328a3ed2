"""Hostile peers over shared memory: files that are not what they seem, places that are none, and silence."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from contextlib import ExitStack, suppress
from threading import Event
from typing import Any, TypeAlias

from s2a_bench.transport import Wiring
from s2a_bench.transport.shm.memory import HELLO, MAGIC, PLACE
from s2a_bench.transport.shm.pieces import unpacked
from s2a_bench.types import Action, Token
from tests.hostile.suite import Attack, Case
from tests.hostile.wires.http import png_of_zeros

ODD: tuple[Any, ...] = (-1, 1.5, [], 1 << 40)
Does: TypeAlias = "Callable[[socket.socket], None]"
MIB = 1 << 20


def file_of(size: int, content: bytes = b"") -> int:
    """Return anonymous memory."""
    file = os.memfd_create("hostile")
    os.ftruncate(file, size)
    os.pwrite(file, content, 0)
    return file


def hello(link: socket.socket, file: int, size: int) -> None:
    """Hand memory over, and forget it."""
    socket.send_fds(link, [HELLO.pack(MAGIC, size)], [file] if file >= 0 else [])
    if file >= 0:
        os.close(file)


def attack(does: Does, seconds: float = 2.0) -> Attack:
    """Return a client that does something and then listens until the server closes, or for ``seconds``."""

    def run(wiring: Wiring[Any]) -> str:
        said = ""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link, ExitStack() as stack:
            link.settimeout(seconds)
            link.connect(wiring.address)
            memory = -1
            with suppress(OSError):
                does(link)
                while len(said) < MIB:
                    data, files, _, _ = socket.recv_fds(link, 1 << 16, 8)
                    for file in files:
                        stack.callback(os.close, memory := file)
                    if not data:
                        break
                    if len(data) == PLACE.size and not files and memory >= 0:
                        begin, length = PLACE.unpack(data)
                        pieces = [*unpacked(os.pread(memory, length, begin))]
                        said += "".join(
                            each.text if isinstance(each, (Token, Action)) else str(each) for each in pieces
                        )
                        if not isinstance(pieces[-1], (Token, Action)):
                            break
                    elif not files:
                        said += data.decode(errors="replace")
        return said

    return run


def asks(
    header: bytes, pictures: bytes = b"", at: int | None = None, length: int | None = None, seconds: float = 2.0
) -> Attack:
    """Return a client whose request has such a header, which lies where it belongs unless told."""

    def does(link: socket.socket) -> None:
        body = pictures + header
        size = max(len(body), 1)
        hello(link, file_of(size, body), size)
        where = len(pictures) if at is None else at
        link.send(PLACE.pack(where, len(header) if length is None else length))

    return attack(does, seconds)


def fields(**more: Any) -> bytes:
    """Return a header."""
    return json.dumps(
        {"id": "a", "prompt": "go", "max_tokens": 2, "grammar": "", "seed": 0, "state": [], "images": [], **more}
    ).encode()


def picture(**more: Any) -> bytes:
    """Return a header with one picture of 4x2."""
    return fields(images=[{"encoding": "bgr8", "width": 4, "height": 2, "bytes": 24, **more}])


def encoded(*files: bytes) -> tuple[bytes, bytes]:
    """Return a header with such files as pictures, and these."""
    return fields(images=[{"encoding": "image/png", "bytes": len(file)} for file in files]), b"".join(files)


def goes(link: socket.socket) -> None:
    """Leave at once."""
    link.shutdown(socket.SHUT_RDWR)


def sends(*packets: bytes) -> Does:
    """Return what sends packets."""

    def does(link: socket.socket) -> None:
        for packet in packets:
            link.send(packet)

    return does


def does_not_read(link: socket.socket) -> None:
    """Ask for more than the memory holds, and read nothing."""
    header = fields(max_tokens=60_000)
    hello(link, file_of(len(header), header), len(header))
    link.send(PLACE.pack(0, len(header)))
    Event().wait(1.0)
    link.shutdown(socket.SHUT_RDWR)


CLIENTS: tuple[Case[Attack], ...] = (
    Case("silence", attack(sends(), seconds=1)),
    Case("gone at once", attack(goes)),
    Case("request without memory", attack(sends(PLACE.pack(64, 10))), "no s2a-bench"),
    Case("memory without a file", attack(lambda link: hello(link, -1, 4096)), "should be one file"),
    Case("1 TiB of memory", attack(lambda link: hello(link, file_of(4096), 1 << 40)), "at most"),
    Case("more memory than the file has", attack(lambda link: hello(link, file_of(4096), MIB))),
    Case("no JSON", asks(b"{]" * 50), "internal error"),
    Case("deep JSON", asks(b"[" * 100_000), "internal error"),
    Case("picture of other sides", asks(picture(width=5), bytes(24)), "internal error"),
    Case("unknown encoding", asks(picture(encoding="tiff"), bytes(24)), "neither a JPEG nor a PNG"),
    Case(
        "ten pictures of 36 megapixels",
        asks(*encoded(*[png_of_zeros(6000, 6000)] * 10), seconds=30),
        "at most .* pixels",
    ),
    *(Case(f"max_tokens {value}", asks(fields(max_tokens=value)), "max_tokens") for value in ODD),
    *(Case(f"state {value}", asks(fields(state=value)), "the state") for value in (7, ["x"], [[1]], {"a": 1}, [1e39])),
    Case("reads nothing", attack(does_not_read)),
)
