"""Sources of pictures: a FrameSource delivers frames, one at a time, in its native format."""

from __future__ import annotations

from typing import Final, Protocol

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, UsageError
from s2a_bench.registry import Registry
from s2a_bench.types import Encoding, Frame, Pixels

MOST_PIXELS: Final = 50_000_000
"""The most of a picture; OpenCV's own limit for files is the same (`s2a_bench/__init__.py`)."""


class FrameSource(Protocol):
    """A camera, real or not. Every frame of one source has the same size and encoding."""

    name: str
    encoding: Encoding
    width: int
    height: int

    def read(self) -> Frame:
        """Return the next frame, blocking until there is one; raises SourceError."""

    def close(self) -> None:
        """Release the device or file; may be called twice."""


class SourceKind(Protocol):
    """Opens sources of one kind: usually the class itself."""

    where: str
    """The text after the name and a colon in usage messages, as ``FILE``; empty if there is none."""

    def __call__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> FrameSource:
        """Open ``where``; raises UsageError for an impossible size, SourceError if it cannot deliver."""


SOURCES: Final[Registry[SourceKind]] = Registry(
    "frame_sources",
    "source",
    {
        "synthetic": "s2a_bench.frames.synthetic:SyntheticCamera",
        "video": "s2a_bench.frames.files:VideoFile",
        "images": "s2a_bench.frames.files:ImageFolder",
        "v4l2": "s2a_bench.frames.v4l2:V4L2Camera",
        "bag": "s2a_bench.frames.bag:Recording",
        "ros": "s2a_bench.frames.ros:TopicCamera",
    },
)


def open_source(spec: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> FrameSource:
    """Open ``name[:where]``, delivering frames of ``width`` x ``height`` pixels.

    Raises UsageError for an unknown name, a missing or superfluous ``where``, SourceError if it cannot deliver.
    """
    name, _, where = spec.partition(":")
    kind = SOURCES[name]
    if bool(where) != bool(kind.where):
        wanted = f"{name}:{kind.where}" if kind.where else f"plain '{name}'"
        raise UsageError(f"`source`: '{spec}' should be {wanted}")
    return kind(where, width, height, fps=fps, seed=seed)


class NumberedSource:
    """Base of built-in sources: numbers and stamps the pictures of a subclass, ``bgr8`` unless it says otherwise."""

    encoding: Encoding = "bgr8"

    def __init__(self, name: str, width: int, height: int, *, smallest: int = 1, even: bool = False) -> None:
        check_size(width, height, smallest=smallest, even=even)
        self.name, self.width, self.height = name, width, height
        self._index = 0
        self._closed = False

    def read(self) -> Frame:
        if self._closed:
            raise SourceError(f"`source`: {self.name} was closed, it has no more frames")
        stamp_ns = self._grab()
        frame = Frame(self._index, stamp_ns, self.width, self.height, self.encoding, self._picture())
        self._index += 1
        return frame

    def close(self) -> None:
        self._closed = True

    def _grab(self) -> int:
        """Return the stamp of the next picture: the time of reading, unless a driver knows better."""
        return now_ns()

    def _picture(self) -> Pixels:
        raise NotImplementedError


def check_size(width: int, height: int, *, smallest: int = 1, even: bool = False) -> None:
    """Raise UsageError unless a source can have this size; ``even`` is for YUYV, which stores pixels in pairs."""
    if width < smallest or height < smallest:
        raise UsageError(f"`size`: {width}x{height} should be {smallest}x{smallest} or more")
    if even and width % 2:
        raise UsageError(f"`size`: {width}x{height} should have an even width, YUYV holds pixels in pairs")
