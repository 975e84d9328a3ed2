"""Hostile peers over shared memory: files that are not what they seem, places that are none, and silence."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, TypeAlias

from s2a_bench.testing.hostile import FAILED, Attack, Case, Trap
from s2a_bench.transport import Wiring
from s2a_bench.transport.shm.memory import ANSWER_BYTES, EVENT, HELLO, PACKET, PICTURES_AT, REQUEST, SEALS

Does: TypeAlias = "Callable[[socket.socket], None]"
MIB = 1 << 20


def file_of(size: int, content: bytes = b"", *, sealed: bool = True, at: int = PICTURES_AT) -> int:
    """Return anonymous memory."""
    file = os.memfd_create("hostile", os.MFD_ALLOW_SEALING)
    os.ftruncate(file, size)
    os.pwrite(file, content, at)
    if sealed:
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, SEALS)
    return file


def hello(link: socket.socket, file: int, size: int) -> None:
    """Hand memory over, and forget it."""
    socket.send_fds(link, [PACKET.pack(HELLO, size, 0)], [file] if file >= 0 else [])
    if file >= 0:
        os.close(file)


def attack(does: Does, seconds: float = 2.0) -> Attack:
    """Return a client that does something and then listens until the server closes, or for ``seconds``."""

    def run(told: Wiring[Any]) -> str:
        said = b""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.settimeout(seconds)
            link.connect(told.address)
            memory: int | None = None
            with suppress(OSError):
                does(link)
                while len(said) < MIB:
                    data, files, _, _ = socket.recv_fds(link, 1 << 16, 8)
                    if not data:
                        break
                    memory = files[0] if files else memory
                    what, at, length = PACKET.unpack(data)
                    if what == EVENT and memory is not None:
                        said += os.pread(memory, length, at % ANSWER_BYTES)
        return said.decode(errors="replace")

    return run


def asks(header: bytes, pictures: bytes = b"", at: int | None = None, length: int | None = None) -> Attack:
    """Return a client whose request has such a header, which lies where it belongs unless told."""

    def does(link: socket.socket) -> None:
        body = pictures + header
        size = PICTURES_AT + max(len(body), 1)
        hello(link, file_of(size, body), size)
        where = PICTURES_AT + len(pictures) if at is None else at
        link.send(PACKET.pack(REQUEST, where, len(header) if length is None else length))

    return attack(does)


def fields(**more: Any) -> bytes:
    """Return a header."""
    return json.dumps(
        {"id": "a", "prompt": "go", "max_tokens": 2, "grammar": "", "seed": 0, "images": [], **more}
    ).encode()


def picture(**more: Any) -> bytes:
    """Return a header with one picture of 4x2."""
    return fields(images=[{"encoding": "bgr8", "width": 4, "height": 2, "bytes": 24, **more}])


def goes(link: socket.socket) -> None:
    """Leave at once."""
    link.shutdown(socket.SHUT_RDWR)


def sends(*packets: bytes) -> Does:
    """Return what sends packets."""

    def does(link: socket.socket) -> None:
        for packet in packets:
            link.send(packet)

    return does


def truncates(link: socket.socket) -> None:
    """Offer memory and cut it off afterwards, which reading it would not outlive."""
    file = file_of(MIB, fields(), sealed=False)
    socket.send_fds(link, [PACKET.pack(HELLO, MIB, 0)], [file])
    with suppress(OSError):
        os.ftruncate(file, 0)
    link.send(PACKET.pack(REQUEST, PICTURES_AT, len(fields())))
    os.close(file)


def many_files(link: socket.socket) -> None:
    """Send more files than belong to a packet."""
    files = [file_of(4096) for _ in range(4)]
    socket.send_fds(link, [PACKET.pack(REQUEST, 0, 0)], files)
    for file in files:
        os.close(file)


def does_not_read(link: socket.socket) -> None:
    """Ask for more than the memory holds, and read nothing."""
    header = fields(max_tokens=60_000)
    size = PICTURES_AT + len(header)
    hello(link, file_of(size, header), size)
    link.send(PACKET.pack(REQUEST, PICTURES_AT, len(header)))
    Event().wait(1.0)
    link.shutdown(socket.SHUT_RDWR)


CLIENTS: tuple[Case[Attack], ...] = (
    Case("silence", attack(sends(), seconds=1)),
    Case("gone at once", attack(goes)),
    Case("packet of 3 bytes", attack(sends(b"abc"))),
    Case("packet of 64 KiB", attack(sends(bytes(1 << 16)))),
    Case("packet that is none", attack(sends(PACKET.pack(b"whatever", 1, 2)))),
    Case("request without memory", attack(sends(PACKET.pack(REQUEST, 64, 10)))),
    Case("memory without a file", attack(lambda link: hello(link, -1, 4096))),
    Case("1 TiB of memory", attack(lambda link: hello(link, file_of(4096), 1 << 40))),
    Case("more memory than the file has", attack(lambda link: hello(link, file_of(4096), MIB))),
    Case("no memory", attack(lambda link: hello(link, file_of(4096), 0))),
    Case("a pipe as memory", attack(lambda link: hello(link, os.pipe()[0], 4096))),
    Case("memory that may shrink", attack(lambda link: hello(link, file_of(MIB, fields(), sealed=False), MIB))),
    Case("memory that shrinks", attack(truncates)),
    Case("files with a request", attack(many_files)),
    Case("header beyond the memory", asks(fields(), at=1 << 40), "is none"),
    Case("header of 2^63 bytes", asks(fields(), length=1 << 63), "is none"),
    Case("header before its place", asks(fields(), at=0), "is none"),
    Case("no JSON", asks(b"{]" * 50), "no JSON"),
    Case("100,000 brackets", asks(b"[" * 100_000), "no JSON"),
    Case("a list", asks(b"[1, 2]"), "should be an object"),
    Case("images that are no list", asks(fields(images=7)), "should be an object"),
    Case("image that is no object", asks(fields(images=[7])), "should lie before the header"),
    Case("picture after the header", asks(picture(bytes=1 << 30), bytes(24)), "should lie before the header"),
    Case("picture of other sides", asks(picture(width=5), bytes(24)), "are no bgr8 picture of 5x2"),
    Case("picture of 2^62 pixels", asks(picture(width=1 << 31, height=1 << 31), bytes(24)), "should be a whole number"),
    Case("unknown encoding", asks(picture(encoding="tiff"), bytes(24)), "neither a JPEG nor a PNG|no such picture"),
    Case("half a surrogate", asks(fields().replace(b'"go"', b'"\\ud800"')), "no JSON|surrogate"),
    *(Case(f"max_tokens {value}", asks(fields(max_tokens=value)), "max_tokens") for value in (-1, 1.5, [], 1 << 40)),
    Case("reads nothing", attack(does_not_read)),
)


def serves(does: Does, *, asked: bool = True) -> Trap:
    """Return a server that does something with each link, when it has been ``asked``, and then waits."""

    @contextmanager
    def trap(_: Wiring[Any]) -> Iterator[str]:
        over = Event()

        def answer(link: socket.socket) -> None:
            with link, suppress(OSError):
                while asked:
                    data, files, _, _ = socket.recv_fds(link, 1 << 16, 8)
                    for file in files:
                        os.close(file)
                    if not data or data.startswith(REQUEST):
                        break
                does(link)
                over.wait(30)

        def serve() -> None:
            with suppress(OSError):
                while True:
                    link, _ = listener.accept()
                    Thread(target=answer, args=(link,), daemon=True).start()

        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            path = str(Path(folder) / "hostile.sock")
            listener.bind(path)
            listener.listen()
            Thread(target=serve, daemon=True).start()
            try:
                yield path
            finally:
                over.set()
                with suppress(OSError):
                    listener.shutdown(socket.SHUT_RDWR)

    return trap


def tells(*events: bytes, again: bool = False) -> Does:
    """Return what offers memory and tells of events in it, of the last for ever if ``again``."""

    def does(link: socket.socket) -> None:
        file = file_of(ANSWER_BYTES, b"".join(events), at=0)
        hello(link, file, ANSWER_BYTES)
        begin = 0
        for event in events:
            link.send(PACKET.pack(EVENT, begin, len(event)))
            begin += len(event)
        while again:
            link.send(PACKET.pack(EVENT, begin - len(events[-1]), len(events[-1])))

    return does


def points(at: int, length: int) -> Does:
    """Return what tells of an event at a place of the server's choice."""

    def does(link: socket.socket) -> None:
        hello(link, file_of(ANSWER_BYTES), ANSWER_BYTES)
        link.send(PACKET.pack(EVENT, at, length))

    return does


def token(index: int = 0) -> bytes:
    """Return the event of a token."""
    return json.dumps({"index": index, "text": "x", "id": 1}).encode()


SERVERS: tuple[Case[Trap], ...] = (
    Case("silence", serves(sends()), FAILED),
    Case("gone at once", serves(goes, asked=False), FAILED),
    Case("gone when asked", serves(goes), FAILED),
    Case("packet of 3 bytes", serves(sends(b"abc")), FAILED),
    Case("packet that is none", serves(sends(PACKET.pack(b"whatever", 1, 2))), FAILED),
    Case("event without memory", serves(sends(PACKET.pack(EVENT, 0, 10))), FAILED),
    Case("memory without a file", serves(lambda link: hello(link, -1, 4096)), FAILED),
    Case("1 TiB of memory", serves(lambda link: hello(link, file_of(4096), 1 << 40)), FAILED),
    Case("memory that may shrink", serves(lambda link: hello(link, file_of(MIB, sealed=False), MIB)), FAILED),
    Case("event of 2^63 bytes", serves(points(0, 1 << 63)), FAILED),
    Case("event at 2^63", serves(points((1 << 63) + 5, ANSWER_BYTES)), FAILED),
    Case("event across the end", serves(points(ANSWER_BYTES - 1, 2)), FAILED),
    Case("empty event", serves(points(0, 0)), FAILED),
    Case("no JSON", serves(tells(b"{]")), FAILED),
    Case("a number", serves(tells(b"7")), FAILED),
    Case("token without text", serves(tells(b'{"index": 0}')), FAILED),
    Case("token then silence", serves(tells(token())), FAILED),
    Case("endless tokens", serves(tells(token(1), again=True)), FAILED),
    Case("marks that are none", serves(tells(b'{"remote": {"clock": 1}}')), FAILED),
    Case(
        "error with letters that move a cursor", serves(tells(json.dumps({"error": "\x1b[2J\r\n!"}).encode())), FAILED
    ),
)
