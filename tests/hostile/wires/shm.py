"""Hostile clients over shared memory: files that are not what they seem, places that are none, and silence."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

from s2a_bench.transport import Wiring
from s2a_bench.transport.shm.memory import HELLO, MAGIC, PLACE
from s2a_bench.transport.shm.pieces import unpacked
from s2a_bench.types import Action, Token
from tests.hostile.peers import CLOSED, LEFT, MIB, PATIENCE_S, Attack, Case
from tests.hostile.wires.http import bomb


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


def attack(does: Callable[[socket.socket], None], *, leaves: bool = False) -> Attack:
    """Return a client that does something and then listens until it is answered or closed, or leaves."""

    def run(wiring: Wiring[Any], says: str) -> str:
        said, memory = "", -1
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link, ExitStack() as stack:
            link.settimeout(PATIENCE_S)
            link.connect(wiring.address)
            with suppress(BrokenPipeError, ConnectionResetError):
                does(link)
            if leaves:
                return LEFT
            while not (said and re.search(says, said, re.DOTALL)):
                try:
                    data, files, _, _ = socket.recv_fds(link, 1 << 16, 8)
                except TimeoutError:
                    return said
                except OSError:
                    data, files = b"", []
                for file in files:
                    stack.callback(os.close, memory := file)
                if not data:
                    return said + CLOSED
                if len(data) == PLACE.size and not files and memory >= 0:
                    begin, length = PLACE.unpack(data)
                    pieces = unpacked(os.pread(memory, length, begin))
                    said += "".join(each.text if isinstance(each, (Token, Action)) else str(each) for each in pieces)
                elif not files:
                    said += data.decode(errors="replace")
        return said

    return run


def asks(header: bytes, pictures: bytes = b"", at: int | None = None, **more: Any) -> Attack:
    """Return a client whose request has such a header, which lies where it belongs unless told."""

    def does(link: socket.socket) -> None:
        body = pictures + header
        hello(link, file_of(len(body), body), len(body))
        link.send(PLACE.pack(len(pictures) if at is None else at, len(header)))

    return attack(does, **more)


def fields(**more: Any) -> bytes:
    """Return a header."""
    plain = {"id": "a", "prompt": "go", "max_tokens": 2, "grammar": "", "seed": 0, "images": [], "state": []}
    return json.dumps({**plain, **more}).encode()


def picture(**more: Any) -> bytes:
    """Return a header with one picture of 4x2."""
    return fields(images=[{"encoding": "bgr8", "width": 4, "height": 2, "bytes": 24, **more}])


CLIENTS = (
    Case("gone at once", attack(lambda _: None, leaves=True)),
    Case("request without memory", attack(lambda link: link.send(PLACE.pack(64, 10)) and None), "no s2a-bench"),
    Case("memory without a file", attack(lambda link: hello(link, -1, 4096)), "should be one file"),
    Case("more memory than the file has", attack(lambda link: hello(link, file_of(4096), MIB))),
    Case("no JSON", asks(b"{]" * 50), "internal error"),
    Case("deep JSON", asks(b"[" * MIB), "internal error"),
    Case("half a surrogate pair", asks(fields().replace(b'"go"', b'"\\ud800"')), "internal error|surrogate"),
    Case("max_tokens 2^40", asks(fields(max_tokens=1 << 40)), "max_tokens"),
    Case("a state of texts", asks(fields(state=["x"])), "the state"),
    Case("a picture of other sides", asks(picture(width=5), bytes(24)), "internal error"),
    Case("reads nothing", asks(fields(max_tokens=60_000), leaves=True)),
)
BOMB = fields(images=[{"encoding": "image/png", "bytes": len(bomb())}])
LARGE = (
    Case("1 TiB of memory", attack(lambda link: hello(link, file_of(4096), 1 << 40)), "at most"),
    Case("a picture of 900 million pixels", asks(BOMB, bomb()), "."),
)
