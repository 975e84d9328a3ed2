"""The Unix socket at which memory is handed over: a file that its user alone may open, cleaned up by the next start.

An abstract socket would leave no file behind, but has no permissions either: any program in the machine's network
namespace could connect, or take the name first.
"""

from __future__ import annotations

import os
import socket
import stat
import tempfile
from contextlib import closing, suppress
from pathlib import Path
from typing import Final

from s2a_bench.errors import PortInUse, TransportError
from s2a_bench.transport.connections import wait_at_most

_BACKLOG: Final = 128


def listen(path: str) -> tuple[socket.socket, str]:
    """Listen at a path, a new one in a folder of our own if there is none; raises PortInUse, TransportError.

    What has the path listens, so that no other server takes it for dead: it is bound under another name first.
    """
    folder = Path(path).parent if path else _folder()
    bound = folder / f".{os.urandom(3).hex()}"  # short: the name of a socket has at most 107 bytes
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        for left in [Path(path)] if path else folder.glob("*.sock"):
            remove_if_dead(left)
        path = path or str(folder / f"{os.urandom(6).hex()}.sock")
        os.fchmod(listener.fileno(), 0o600)  # which the file will have
        listener.bind(str(bound))
        try:
            listener.listen(_BACKLOG)
            os.link(bound, path)
        finally:
            bound.unlink()
    except OSError as error:
        listener.close()
        raise PortInUse(f"`socket`: {path or folder} cannot be had: {error.strerror or error}") from error
    return listener, path


def connect(path: str, patience_s: float) -> socket.socket:
    """Connect to a server; raises OSError."""
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        wait_at_most(link, patience_s)
        link.connect(path)
    except BaseException:
        link.close()
        raise
    return link


def _folder() -> Path:
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"s2a_bench-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError as error:
        raise TransportError(f"{folder} cannot be had: {error.strerror}; name a `socket`") from error
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise TransportError(f"{folder} is not a folder of ours alone: remove it, or name a `socket`")
    return folder


def remove_if_dead(path: Path) -> None:
    """Remove a socket at which no server listens any more, and nothing else."""
    with suppress(OSError):
        if stat.S_ISSOCK(path.lstat().st_mode):
            with closing(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)) as probe:
                probe.setblocking(False)
                try:
                    probe.connect(str(path))
                except ConnectionRefusedError:
                    path.unlink()
