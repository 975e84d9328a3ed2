"""Frames of a video file, decoded by FFmpeg as they are read, over and over."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, cast

import cv2

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError
from s2a_bench.frames import check_size
from s2a_bench.frames.convert import resize
from s2a_bench.types import Encoding, Frame

if TYPE_CHECKING:
    from s2a_bench.types import Pixels


class VideoFile:
    """A video file as a camera: (h, w, 3) ``bgr8``, resized where the file's size differs.

    After the last frame it starts over, so pictures repeat. read() decodes on one thread and never waits for the
    file's own rate: capture then includes decoding, which a camera would not. ``fps`` and ``seed`` change nothing.
    Raises SourceError for a file that is missing or no video.
    """

    where: ClassVar[str] = "FILE"
    encoding: Encoding = "bgr8"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        """Open the file ``where``."""
        check_size(width, height)
        if not Path(where).is_file():
            raise SourceError(f"`source`: no video file at {where}")
        self.name = f"video:{where}"
        self.width, self.height = width, height
        self._path = where
        self._capture: cv2.VideoCapture | None = self._open()
        self._index = 0

    def read(self) -> Frame:
        """Decode the next frame, after the last one the first; SourceError once closed."""
        stamp_ns = now_ns()
        if self._capture is None:
            raise SourceError(f"`source`: {self.name} was closed, it has no more frames")
        done, picture = self._capture.read()
        if not done:
            # opened afresh, because seeking to frame 0 fails for some codecs
            self._capture.release()
            self._capture = self._open()
            done, picture = self._capture.read()
        if not done:
            raise SourceError(
                f"`source`: {self._path} holds no frame that OpenCV can decode; try `ffprobe {self._path}`"
            )
        data = resize(cast("Pixels", picture), self.width, self.height)
        frame = Frame(self._index, stamp_ns, self.width, self.height, self.encoding, data)
        self._index += 1
        return frame

    def close(self) -> None:
        """Close the file."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _open(self) -> cv2.VideoCapture:
        """Open the file with FFmpeg alone: OpenCV's other back ends only add noise to the failure."""
        capture = cv2.VideoCapture(self._path, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            raise SourceError(f"`source`: {self._path} is no video that OpenCV can read; try `ffprobe {self._path}`")
        return capture
