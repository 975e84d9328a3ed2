"""Memory that two processes share without a name, and the packets that say where in it to look.

A client connects to a Unix socket (SEQPACKET) and hands over a file of memory (memfd) that it writes its requests into;
the server hands over another, for its answers. From then on packets of 16 bytes say where something lies. They wake the
other side about as fast as an eventfd or a futex would (docs/latency.md), and unlike these they end when it does.

- Nothing has a name in /dev/shm: the memory goes when its last process ends, also by a kill.
- Each side maps the other's memory for reading only. Raw pixels are used where they lie.
- Both sides are programs of one user, who alone may open the socket: what they send is not distrusted. What cannot be
  read fails the request, or closes the link.
"""

from __future__ import annotations

import os
import socket
import struct
from mmap import ACCESS_READ, ACCESS_WRITE, mmap
from typing import Final

import numpy as np

from s2a_bench.errors import RequestFailed, TransportError
from s2a_bench.types import Pixels

HELLO: Final = struct.Struct("<8sQ")
"""The first packet of each side: `MAGIC`, and the size of the memory that comes with it."""
MAGIC: Final = b"S2A-SHM2"
"""Its last letter is the version of what follows; both sides have to be of one."""
REFUSED: Final = b"refused:"
"""Begins a server's refusal; the reason follows."""
PLACE: Final = struct.Struct("<QQ")
"""All others: where something lies, and its length. A client's tells of a request's header, behind its pictures, which
begin at 0, one after the other. A server's tells of pieces of the answer, see `pieces`."""
STEP_BYTES: Final = 1 << 20
"""Memory for requests is offered in whole steps."""
ANSWER_BYTES: Final = 64 << 20
"""The longest answer with its marks, which lies there from 0 on until the next one; what is not written takes none."""

_PACKET_BYTES: Final = 256


class SharedMemory:
    """Memory of a file, ours to write or the other side's to read."""

    __slots__ = ("map", "pixels", "size")

    def __init__(self, file: int, size: int, *, writes: bool) -> None:
        self.map = mmap(file, size, access=ACCESS_WRITE if writes else ACCESS_READ)
        self.pixels: Pixels = np.frombuffer(self.map, np.uint8)
        self.size = size


def in_steps(size: int) -> int:
    return -(-size // STEP_BYTES) * STEP_BYTES


def offer(link: socket.socket, size: int) -> SharedMemory:
    """Make memory of so many bytes and hand it over; raises TransportError where there is none, OSError."""
    try:
        file = os.memfd_create("s2a_bench", os.MFD_CLOEXEC)
        try:
            os.ftruncate(file, size)
            memory = SharedMemory(file, size, writes=True)
        except OSError:
            os.close(file)
            raise
    except OSError as error:
        raise TransportError(f"shared memory of {size} bytes cannot be had: {error.strerror}") from error
    try:
        socket.send_fds(link, [HELLO.pack(MAGIC, size)], [file])
    finally:
        os.close(file)
    return memory


def accept(link: socket.socket, most: int) -> SharedMemory:
    """Map what the other side hands over; raises EOFError, OSError, ValueError, TransportError."""
    data, files = _receive(link)
    try:
        if not data:
            raise EOFError
        if data.startswith(REFUSED):
            raise RequestFailed(f"the link was refused: {data[len(REFUSED) :].decode(errors='replace')}")
        if len(data) != HELLO.size or not data.startswith(MAGIC):
            raise TransportError("the other side is no s2a-bench, or one whose shared memory is laid out otherwise")
        _, size = HELLO.unpack(data)
        if len(files) != 1:
            raise TransportError(f"memory should be one file; {len(files)} came (is the limit of open files met?)")
        if size > most:
            raise TransportError(f"shared memory of {size} bytes was offered; at most {most} are taken")
        return SharedMemory(files[0], size, writes=False)
    finally:
        for file in files:
            os.close(file)


def refusal(why: str) -> bytes:
    return (REFUSED + why.encode())[:_PACKET_BYTES]


def _receive(link: socket.socket) -> tuple[bytes, list[int]]:
    try:
        data, files, _, _ = socket.recv_fds(link, _PACKET_BYTES, 4, socket.MSG_CMSG_CLOEXEC)
    except ConnectionResetError:  # it left without reading all; what it sent before can still be read
        data, files, _, _ = socket.recv_fds(link, _PACKET_BYTES, 4, socket.MSG_CMSG_CLOEXEC)
    return data, files
