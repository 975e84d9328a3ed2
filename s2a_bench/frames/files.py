"""Frames of a video file or of a folder of pictures, in a loop."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, cast

import cv2

from s2a_bench.errors import SourceError
from s2a_bench.frames import NumberedSource
from s2a_bench.frames.convert import bgr_to_rgb, decode_image, resize
from s2a_bench.types import Pixels


class VideoFile(NumberedSource):
    """A video file as a camera: (h, w, 3) ``bgr8``; unlike with a camera, capture includes decoding."""

    where: ClassVar[str] = "FILE"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        super().__init__(f"video:{where}", width, height)
        if not Path(where).is_file():
            raise SourceError(f"`source`: no video file at {where}")
        self._path = where
        self._capture = self._open()

    def _picture(self) -> Pixels:
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
        return resize(cast("Pixels", picture), self.width, self.height)

    def close(self) -> None:
        super().close()
        self._capture.release()

    def _open(self) -> cv2.VideoCapture:
        """Open the file with FFmpeg alone: OpenCV's other back ends only add noise to the failure."""
        capture = cv2.VideoCapture(self._path, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            raise SourceError(f"`source`: {self._path} is not a video that OpenCV can read; try `ffprobe {self._path}`")
        return capture


SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".ppm", ".tif", ".tiff", ".webp"})
LIMIT_BYTES = 2**30


class ImageFolder(NumberedSource):
    """A folder of pictures as a camera: (h, w, 3) ``bgr8``.

    All are decoded when the source opens, so that an unreadable one fails at once and capture costs a copy, as from a
    camera.
    """

    where: ClassVar[str] = "FOLDER"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        super().__init__(f"images:{where}", width, height)
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
        self._pictures: list[Pixels] = [resize(_load(path), width, height) for path in paths]

    def _picture(self) -> Pixels:
        return self._pictures[self._index % len(self._pictures)].copy()

    def close(self) -> None:
        super().close()
        self._pictures.clear()


def _load(path: Path) -> Pixels:
    try:
        return bgr_to_rgb(decode_image(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise SourceError(f"`source`: cannot read {path}: {error}") from error
