"""Frames of a video file or of a folder of pictures, over and over."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, cast

import cv2

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError
from s2a_bench.frames import check_size
from s2a_bench.frames.convert import bgr_to_rgb, decode_image, resize
from s2a_bench.types import Encoding, Frame, Pixels


class VideoFile:
    """A video file as a camera: (h, w, 3) ``bgr8``, resized where the file's size differs.

    After the last frame it starts over, so pictures repeat. read() decodes on one thread and never waits for the
    file's own rate: capture then includes decoding, which a camera would not. ``fps`` and ``seed`` change nothing.
    Raises SourceError for a file that is missing or no video.
    """

    where: ClassVar[str] = "FILE"
    encoding: Encoding = "bgr8"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        check_size(width, height)
        if not Path(where).is_file():
            raise SourceError(f"`source`: no video file at {where}")
        self.name = f"video:{where}"
        self.width, self.height = width, height
        self._path = where
        self._capture: cv2.VideoCapture | None = self._open()
        self._index = 0

    def read(self) -> Frame:
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
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _open(self) -> cv2.VideoCapture:
        """Open the file with FFmpeg alone: OpenCV's other back ends only add noise to the failure."""
        capture = cv2.VideoCapture(self._path, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            raise SourceError(f"`source`: {self._path} is no video that OpenCV can read; try `ffprobe {self._path}`")
        return capture


SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".ppm", ".tif", ".tiff", ".webp"})
LIMIT_BYTES = 2**30


class ImageFolder:
    """A folder of pictures as a camera: (h, w, 3) ``bgr8``, resized where a picture's size differs.

    All pictures are decoded when the source opens, so that an unreadable one shows at once and capture costs a copy,
    as it does from a camera. After the last picture comes the first again. ``fps`` and ``seed`` change nothing.
    Raises SourceError for a folder that is missing, empty, too large to hold decoded, or has an unreadable picture.
    """

    where: ClassVar[str] = "FOLDER"
    encoding: Encoding = "bgr8"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        """Decode every picture of the folder ``where``; files of other kinds and subfolders are passed over."""
        check_size(width, height)
        folder = Path(where)
        if not folder.is_dir():
            raise SourceError(f"`source`: no folder at {where}")
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
        if not paths:
            raise SourceError(f"`source`: no pictures in {where}; it takes {', '.join(sorted(SUFFIXES))}")
        if len(paths) > (most := LIMIT_BYTES // (width * height * 3)):
            raise SourceError(
                f"`source`: {where} holds {len(paths)} pictures; decoded to {width}x{height}, {most} fit into "
                f"{LIMIT_BYTES >> 20} MiB: point at a folder of fewer, or give a smaller `size`"
            )
        self.name = f"images:{where}"
        self.width, self.height = width, height
        self._pictures: list[Pixels] = [resize(_load(path), width, height) for path in paths]
        self._index = 0

    def read(self) -> Frame:
        stamp_ns = now_ns()
        if not self._pictures:
            raise SourceError(f"`source`: {self.name} was closed, it has no more frames")
        data = self._pictures[self._index % len(self._pictures)].copy()
        frame = Frame(self._index, stamp_ns, self.width, self.height, self.encoding, data)
        self._index += 1
        return frame

    def close(self) -> None:
        self._pictures.clear()


def _load(path: Path) -> Pixels:
    """Read one picture as ``bgr8``, naming it if that fails."""
    try:
        return bgr_to_rgb(decode_image(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise SourceError(f"`source`: cannot read {path}: {error}") from error
