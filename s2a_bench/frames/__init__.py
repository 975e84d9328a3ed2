"""Where pictures come from: a FrameSource delivers frames, one at a time, in its native format."""

from __future__ import annotations

from typing import Final, Protocol

from s2a_bench.errors import UsageError
from s2a_bench.registry import Registry
from s2a_bench.types import Encoding, Frame


class FrameSource(Protocol):
    """A camera, real or not. Every frame of one source has the same size and encoding."""

    name: str
    encoding: Encoding
    width: int
    height: int

    def read(self) -> Frame:
        """Return the next frame, blocking until there is one; raises SourceError."""
        ...

    def close(self) -> None:
        """Release the device or file; may be called twice."""
        ...


class SourceKind(Protocol):
    """What opens sources of one kind: usually the class itself."""

    where: str
    """What to write after the name and a colon, as ``FILE``; empty where nothing is."""

    def __call__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> FrameSource:
        """Open ``where``; raises UsageError for a size it cannot have, SourceError where it cannot deliver."""
        ...


SOURCES: Final[Registry[SourceKind]] = Registry(
    "frame_sources",
    "source",
    {
        "synthetic": "s2a_bench.frames.synthetic:SyntheticCamera",
        "video": "s2a_bench.frames.files:VideoFile",
        "images": "s2a_bench.frames.files:ImageFolder",
        "v4l2": "s2a_bench.frames.v4l2:V4L2Camera",
        "bag": "s2a_bench.frames.bag:Recording",
    },
)
"""What opens each kind of source."""


def open_source(spec: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> FrameSource:
    """Open ``name[:where]``, delivering frames of ``width`` x ``height`` pixels.

    Raises UsageError for an unknown name or a ``where`` missing or too many, SourceError when it cannot deliver.
    """
    name, _, where = spec.partition(":")
    kind = SOURCES[name]
    if bool(where) != bool(kind.where):
        wanted = f"{name}:{kind.where}" if kind.where else f"plain '{name}'"
        raise UsageError(f"`source`: '{spec}' should be {wanted}")
    return kind(where, width, height, fps=fps, seed=seed)


def check_size(width: int, height: int, *, smallest: int = 1, even: bool = False) -> None:
    """Raise UsageError unless a source can have this size; ``even`` is for YUYV, which holds pixels in pairs."""
    if width < smallest or height < smallest:
        raise UsageError(f"`size`: {width}x{height} should be {smallest}x{smallest} or more")
    if even and width % 2:
        raise UsageError(f"`size`: {width}x{height} should have an even width, YUYV holds pixels in pairs")
