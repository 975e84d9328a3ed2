"""The wire format of both sides: this user's domain of iceoryx2, its services and events, the layout of its slices.

A request is one slice: `HEAD`, a header in JSON, then the pictures. An answer is a stream of lines of JSON, a slice for
each piece; the client counts in `HEAD` what it has read, and what it is too slow for goes into one of the next slices.
Slices say which request they belong to, as a client may receive those of the one whose place it took, and are counted,
so that a lost one is an error. Events wake the other side.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import stat
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final, TypeAlias
from zlib import crc32

import iceoryx2
import orjson

from s2a_bench.errors import TransportError
from s2a_bench.trace import Remote
from s2a_bench.types import Action, Piece, Token
from s2a_bench.vectors import actions_of

HEAD: Final = struct.Struct("=QQQQ")
"""Begins a request: the slices of the answer that its client has read, its client, its number, its header's bytes."""
SLICE: Final = struct.Struct("=QQ")
"""Begins a slice of an answer: the number of its request, and how many slices the answer had before."""
SLICE_BYTES: Final = 1 << 13
"""The longest slice of an answer."""
UNREAD: Final = 32
"""The most slices of an answer that its client leaves unread."""
ACTIVE: Final = 2
"""The most requests of one client, those that it gave up included; iceoryx2 keeps twice as many slices, and one."""
CLIENTS: Final = 64
"""Clients of a server, at most."""
POLL_S: Final = 0.1
"""Longest wait for an event before the other side is checked."""
PAUSE_S: Final = 0.002
"""Poll interval where no event wakes: of a lock, and of a slow client's reads while the engine is free."""
LOCK_S: Final = 1.0
"""Longest wait for a process that joins or leaves."""
PATH_BYTES: Final = 48
"""The longest path of the folder: a socket's has at most 107, and iceoryx2 adds a name."""
MEMORY: Final = Path("/dev/shm")  # noqa: S108 - where POSIX shared memory lies on Linux
ERRORS: Final[tuple[type[Exception], ...]] = tuple(
    each for each in vars(iceoryx2).values() if isinstance(each, type) and issubclass(each, Exception)
)
"""All exceptions of iceoryx2, which share no base; each says its kind in one word."""
UNUSABLE: Final[tuple[type[Exception], ...]] = (*ERRORS, OSError, UnicodeError)
"""Exceptions for a folder that iceoryx2 cannot use."""

AnswerPart: TypeAlias = "Piece | Remote | str"
"""A piece, the server's marks at the end of an answer, or the error that ended it."""


class Domain:
    """This user's processes of s2a-bench, apart from all others that use iceoryx2, and this process's node in it.

    A new node removes what dead ones left, by iceoryx2's own means.
    """

    def __init__(self) -> None:
        """Join; raises TransportError."""
        self.folder = _folder()
        self._prefix = prefix_of(self.folder)
        self._config = iceoryx2.config.default()
        iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
        try:
            self._config.global_cfg.root_path = iceoryx2.Path.new(str(self.folder))
            self._config.global_cfg.prefix = iceoryx2.FileName.new(self._prefix)
            builder = iceoryx2.NodeBuilder.new().config(self._config)
            builder = builder.signal_handling_mode(iceoryx2.SignalHandlingMode.Disabled)
            with self._locked():
                self._node: Any = builder.create(iceoryx2.ServiceType.Ipc)
        except UNUSABLE as error:
            raise TransportError(f"iceoryx2 cannot be used in {self.folder}: {error}; set XDG_RUNTIME_DIR") from error

    def requests(self, name: str) -> Any:
        """Return the builder of a server's requests and answers, both slices of bytes."""
        data = iceoryx2.Slice[ctypes.c_uint8]
        return self._node.service_builder(iceoryx2.ServiceName.new(name)).request_response(data, data)

    def event(self, name: str, client: int | None = None) -> Any:
        """Return the builder of the event that wakes a server, or one of its clients."""
        whole = f"{name}/wake" if client is None else f"{name}/wake/{client:016x}"
        return self._node.service_builder(iceoryx2.ServiceName.new(whole)).event()

    def clean(self) -> None:
        """Remove the leftovers of killed processes; their events then have no listener."""
        self._node.try_cleanup_dead_nodes()

    def leave(self) -> None:
        """Leave, after all ports; the last node of the domain removes iceoryx2's counter of nodes."""
        self._node = None
        with suppress(*UNUSABLE), self._locked():  # the folder may be gone, with a session of the user
            if not iceoryx2.Node.list(iceoryx2.ServiceType.Ipc, self._config):
                for counter in MEMORY.glob(f"{self._prefix}*.global_mgmt"):
                    counter.unlink()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Let one process at a time join or leave; one that was stopped meanwhile delays the others by `LOCK_S`."""
        file, ends = os.open(self.folder, os.O_RDONLY), monotonic() + LOCK_S
        try:
            while monotonic() < ends:
                with suppress(BlockingIOError):
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                sleep(PAUSE_S)
            yield
        finally:
            os.close(file)


def _folder() -> Path:
    """Return the folder of nodes and services, which this user alone may enter."""
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"s2a_bench-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        facts = folder.lstat()
    except OSError as error:
        raise TransportError(f"{folder} cannot be made: {error.strerror}; see XDG_RUNTIME_DIR") from error
    if len(os.fsencode(folder)) > PATH_BYTES:
        raise TransportError(f"{folder} is too long a path for the sockets in it: set XDG_RUNTIME_DIR to a shorter one")
    if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.getuid() or facts.st_mode & 0o077:
        raise TransportError(f"{folder} is not a folder of this user alone: remove it, or set XDG_RUNTIME_DIR")
    return folder


def prefix_of(folder: Path) -> str:
    """Return how names in shared memory begin."""
    return f"s2a_{crc32(os.fsencode(folder)):08x}_"


def listens(event: Any) -> bool:
    """Return whether the process that an event wakes is there; one that was killed is until `Domain.clean`."""
    return bool(event.dynamic_config.number_of_listeners)


def wait(listener: Any, seconds: float) -> bool:
    """Wait for an event; return False after this time. A signal ends the wait, too."""
    try:
        return bool(listener.timed_wait(iceoryx2.Duration.from_micros(max(1, round(seconds * 1e6)))))
    except iceoryx2.ListenerWaitError as error:
        if "Interrupt" not in str(error):
            raise
        return True


def room_for(size: int) -> None:
    """Raise TransportError if shared memory lacks these bytes: to write beyond them would end the process."""
    try:
        there = os.statvfs(MEMORY)
    except OSError as error:
        raise TransportError(f"{MEMORY} cannot be used: {error.strerror}") from error
    if size > (free := there.f_bavail * there.f_frsize):
        raise TransportError(f"{MEMORY} has {free} bytes free, and a request takes {size}: docker run --shm-size")


def bytes_in(lent: Any) -> memoryview:
    """Return the bytes of a slice where they lie; they must not outlive it."""
    view: memoryview = lent.payload().as_memory_view().cast("B")
    return view


def packed(part: AnswerPart) -> bytes:
    """Return a line of JSON."""
    line: list[Any]
    if isinstance(part, Token):
        line = ["token", part.index, part.text, part.id]
    elif isinstance(part, Action):
        line = ["action", part.index, part.values.tolist()]
    elif isinstance(part, Remote):
        line = ["end", part]
    else:
        line = ["error", part]
    return orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE)


def unpacked(stream: bytearray) -> Iterator[AnswerPart]:
    """Take whole lines off a stream; raises RequestFailed, ValueError, KeyError or TypeError for malformed ones."""
    end = stream.rfind(b"\n") + 1
    lines = bytes(stream[:end]).splitlines()
    del stream[:end]
    for line in lines:
        match orjson.loads(line):
            case ["token", int(index), str(text), int(number)]:
                yield Token(index, text, number)
            case ["action", int(index), values]:
                yield from actions_of(values, index)
            case ["end", marks]:
                yield Remote.of_json(marks)
            case ["error", str(message)]:
                yield message
            case _:
                raise ValueError(f"a line of an unknown kind: {line[:40]!r}")
