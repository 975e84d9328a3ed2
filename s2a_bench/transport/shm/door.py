"""The Unix socket at which memory is handed over: a file that its user alone may open, cleaned up by the next start.

An abstract socket would leave no file behind, but has no permissions either: any program in the machine's network
namespace could connect, or take the name first. Both ends ask the kernel who the other is (SO_PEERCRED) all the same.
"""

from __future__ import annotations

import fcntl
import os
import socket
import stat
import struct
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from errno import EAGAIN
from pathlib import Path
from typing import Final

from s2a_bench.errors import PortInUse, TransportError

ROOT: Final = 0
_CREDENTIALS = struct.Struct("3i")
_TIMEVAL = struct.Struct("@ll")
_BACKLOG = 128
_LOCK_TRIES, _LOCK_PAUSE_S = 100, 0.05


def listen(path: str) -> socket.socket:
    """Listen at a path, a new one in a folder of our own if there is none; raises PortInUse, TransportError."""
    folder = Path(path).parent if path else _folder()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        with _alone_in(folder):
            for left in [Path(path)] if path else folder.glob("*.sock"):
                _remove_if_dead(left)
            path = path or str(folder / f"{os.urandom(6).hex()}.sock")
            os.fchmod(listener.fileno(), 0o600)  # which the file will have
            listener.bind(path)
            listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise PortInUse(f"`socket`: {path or folder} cannot be had: {error.strerror or error}") from error
    return listener


def connect(path: str, patience_s: float) -> socket.socket:
    """Connect to a server of our own user; raises OSError, TransportError."""
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        wait_at_most(link, patience_s)
        link.connect(path)
        user = user_of(link)
        if os.getuid() not in {user, ROOT} and user != ROOT:
            raise TransportError(f"the server at {path} is another user's (uid {user}): it would see the pictures")
    except BaseException:
        link.close()
        raise
    return link


def wait_at_most(link: socket.socket, seconds: float) -> None:
    """Let blocking calls end with BlockingIOError after so long, 0: never; `settimeout` would cost each a poll."""
    whole = int(seconds)
    value = _TIMEVAL.pack(whole, max(int((seconds - whole) * 1e6), int(seconds > 0 and not whole)))
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, value)


def may_ask(link: socket.socket) -> bool:
    """Whether the client at the other end is one of our own user's, or root."""
    return user_of(link) in {os.getuid(), ROOT}


def user_of(link: socket.socket) -> int:
    """Return the user id of the process at the other end, as the kernel knows it."""
    _, user, _ = _CREDENTIALS.unpack(link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return int(user)


def _folder() -> Path:
    """Return the folder of our sockets, which nobody else may enter."""
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"s2a_bench-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError as error:
        raise TransportError(f"{folder} cannot be had: {error.strerror}; name a `socket`") from error
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise TransportError(f"{folder} is not a folder of ours alone: remove it, or name a `socket`")
    return folder


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep others from cleaning up between our `bind` and `listen`, when nobody seems to listen there."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for _ in range(_LOCK_TRIES):
            with suppress(BlockingIOError):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(_LOCK_PAUSE_S)
        else:
            raise BlockingIOError(EAGAIN, f"somebody keeps {folder} locked")
        yield
    finally:
        os.close(handle)


def _remove_if_dead(path: Path) -> None:
    """Remove the socket of a server that was killed: nobody listens there."""
    with suppress(OSError):
        if stat.S_ISSOCK(path.lstat().st_mode):
            with closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as probe:
                probe.setblocking(False)
                try:
                    probe.connect(str(path))
                except ConnectionRefusedError:
                    path.unlink()
