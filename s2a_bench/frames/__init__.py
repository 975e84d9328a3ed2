"""Where pictures come from: a FrameSource delivers frames, one at a time, in its native format."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Protocol

from s2a_bench.errors import UsageError
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


SOURCES: dict[str, str] = {
    "synthetic": "s2a_bench.frames.synthetic:SyntheticCamera",
    "video": "s2a_bench.frames.video:VideoFile",
    "images": "s2a_bench.frames.images:ImageFolder",
    "v4l2": "s2a_bench.frames.v4l2:V4L2Camera",
    "bag": "s2a_bench.frames.bag:Recording",
}
"""Scheme of ``--source scheme[:where]`` -> class, built as ``Class(where, width, height, fps=..., seed=...)``."""


def open_source(spec: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> FrameSource:
    """Open what ``--source`` names, delivering frames of ``width`` x ``height`` pixels.

    Raises UsageError for an unknown scheme and SourceError when it cannot deliver.
    """
    scheme, _, where = spec.partition(":")
    if scheme not in SOURCES:
        raise UsageError(f"--source: '{spec}' is none of synthetic, video:FILE, images:DIR, v4l2:DEVICE, bag:FILE")
    if bool(where) == (scheme == "synthetic"):
        raise UsageError(f"--source: '{spec}' should be " + (f"{scheme}:PATH" if not where else "plain 'synthetic'"))
    source: FrameSource = resolve_name(SOURCES[scheme])(where, width, height, fps=fps, seed=seed)
    return source


def check_size(width: int, height: int, *, smallest: int = 1, even: bool = False) -> None:
    """Raise UsageError unless a source can have this size; ``even`` is for YUYV, which holds pixels in pairs."""
    if width < smallest or height < smallest:
        raise UsageError(f"--size: {width}x{height} should be {smallest}x{smallest} or more")
    if even and width % 2:
        raise UsageError(f"--size: {width}x{height} should have an even width, YUYV holds pixels in pairs")
