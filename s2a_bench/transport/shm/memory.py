"""Memory that two processes share, and packets that say where in it to look.

A client connects to a Unix socket (SEQPACKET) and hands over an anonymous file of memory (memfd), for its requests; the
server hands over another for answers. From then on packets of 24 bytes say what lies where. A packet wakes the
other side as fast as an eventfd would, and its end tells that the other side has gone. Anonymous memory has no name:
nothing of it stays behind in /dev/shm, whoever is killed.

Memory is sealed: whoever maps it checks that its size cannot change, as reading beyond the end of what the other side
has cut off would be a SIGBUS.
"""

from __future__ import annotations

import fcntl
import os
import socket
import stat
import struct
import tempfile
from contextlib import closing, suppress
from mmap import ACCESS_READ, ACCESS_WRITE, mmap
from pathlib import Path
from typing import Final

import numpy as np

from s2a_bench.errors import PortInUse, TransportError
from s2a_bench.types import Pixels

PACKET: Final = struct.Struct("<8sQQ")
"""What it is, and two numbers."""
HELLO: Final = b"S2A-SHM1"
"""With a file: memory for what follows, of so many bytes; the second number is 0."""
REQUEST: Final = b"request\0"
"""Where its header lies, after its pictures, and the header's length."""
EVENT: Final = b"event\0\0\0"
"""How many bytes of events were written before it, and its length; it lies there, as the memory goes round."""
READ: Final = struct.Struct("<Q")
"""At the beginning of the memory for requests: how many bytes of events the client has read."""
PICTURES_AT: Final = 64
ANSWER_BYTES: Final = 1 << 20
"""What a server may be ahead of its client."""
SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
OURS: Final = "s2a_bench-"


class Memory:
    """Memory of a file, ours to write or the other side's to read."""

    def __init__(self, file: int, size: int, *, writes: bool) -> None:
        """Map the file, which is closed then."""
        try:
            self._map = mmap(file, size, access=ACCESS_WRITE if writes else ACCESS_READ)
        finally:
            os.close(file)
        self.bytes: Pixels = np.frombuffer(self._map, np.uint8)
        self.size = size

    @classmethod
    def received(cls, files: list[int], size: int, most: int) -> Memory:
        """Map what the other side handed over; raises TransportError for what is not to be trusted."""
        file, *more = files or [-1]
        for extra in more:
            os.close(extra)
        try:
            if file < 0 or not 0 < size <= most:
                raise TransportError(f"{size} bytes of shared memory were offered; at most {most} are taken")
            if os.fstat(file).st_size < size or fcntl.fcntl(file, fcntl.F_GET_SEALS) & SEALS != SEALS:
                raise TransportError("shared memory was offered whose size may change")
        except (OSError, TransportError) as error:
            if file >= 0:
                os.close(file)
            raise TransportError(str(error)) from error
        return cls(file, size, writes=False)


def offered(link: socket.socket, size: int) -> Memory:
    """Make memory of so many bytes and hand it over."""
    file = os.memfd_create("s2a_bench", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(file, size)
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, SEALS | fcntl.F_SEAL_SEAL)
        socket.send_fds(link, [PACKET.pack(HELLO, size, 0)], [file])
    except OSError:
        os.close(file)
        raise
    return Memory(file, size, writes=True)


def receive(link: socket.socket) -> tuple[bytes, int, int, list[int]]:
    """Return the next packet: what it is, its numbers, and files that came with it; raises EOFError, ValueError."""
    data, files, _, _ = socket.recv_fds(link, PACKET.size + 1, 4)
    try:
        if not data:
            raise EOFError
        if len(data) != PACKET.size:
            raise ValueError(f"a packet of {len(data)} bytes is none of ours")
    except (EOFError, ValueError):
        for file in files:
            os.close(file)
        raise
    what, first, second = PACKET.unpack(data)
    if files and what != HELLO:
        for file in files:
            os.close(file)
        raise ValueError("a file came with a packet that has none")
    return what, first, second, files


def listen(path: str) -> socket.socket:
    """Listen at a path, a new one in a folder of our own if there is none; raises PortInUse, TransportError."""
    if not path:
        folder = _folder()
        _clean(folder)
        path = str(folder / f"{os.urandom(6).hex()}.sock")
    else:
        _forget(Path(path))
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    before = os.umask(0o177)
    try:
        listener.bind(path)
        listener.listen(128)
    except OSError as error:
        listener.close()
        raise PortInUse(f"`socket`: {path} cannot be had: {error.strerror or error}") from error
    finally:
        os.umask(before)
    return listener


def _folder() -> Path:
    """Return the folder of our sockets, which nobody else may enter."""
    folder = Path(tempfile.gettempdir()) / f"{OURS}{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise TransportError(f"{folder} is not a folder of ours alone: remove it, or name a `socket`")
    return folder


def _clean(folder: Path) -> None:
    """Remove what servers that were killed left behind."""
    for path in folder.glob("*.sock"):
        _forget(path)


def _forget(path: Path) -> None:
    """Remove a socket at which nobody listens."""
    with suppress(OSError):
        if stat.S_ISSOCK(path.lstat().st_mode):
            with closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as probe:
                try:
                    probe.connect(str(path))
                except ConnectionRefusedError:
                    path.unlink()
