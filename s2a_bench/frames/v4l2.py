"""Real cameras through Linux' V4L2: a camera as a source of its driver's YUYV, and the list of cameras."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, cast

import cv2

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError
from s2a_bench.frames import NumberedSource
from s2a_bench.types import Encoding, Pixels

VIDIOC_QUERYCAP = 0x80685600
VIDIOC_ENUM_FMT = 0xC0405602
VIDIOC_ENUM_FRAMESIZES = 0xC02C564A
"""``linux/videodev2.h``: fill a struct v4l2_capability, v4l2_fmtdesc, v4l2_frmsizeenum."""
CAPABILITY = struct.Struct("16s32s32sIII12x")
"""struct v4l2_capability: driver, card, bus, version, capabilities, device_caps, reserved."""
FORMAT = struct.Struct("III32sI16x")
"""struct v4l2_fmtdesc: index, type, flags, description, pixelformat, mbus_code and reserved."""
FRAME_SIZE = struct.Struct("III6I8x")
"""struct v4l2_frmsizeenum: index, pixel_format, type, then width and height, or both as minimum, maximum, step."""
CAN_CAPTURE, CAN_CAPTURE_PLANES, HAS_DEVICE_CAPS = 0x00000001, 0x00001000, 0x80000000
CAPTURE, CAPTURE_PLANES = 1, 9
DISCRETE = 1
MOST = 64
"""The most entries of a list that are read: a driver might never end it."""

QUEUE = 10
"""The most buffers that OpenCV has a driver fill; its default is 4."""
AT_ONCE_NS = 1_000_000
"""A frame delivered faster than this was waiting in the queue."""

Ioctl = Callable[[int, int, bytes], bytes]


class V4L2Camera(NumberedSource):
    """A V4L2 capture device: (h, w, 2) ``yuv422_yuy2``, not converted.

    ``stamp_ns`` is the driver's time of capture if it stamps with CLOCK_MONOTONIC, as USB cameras do, else the time of
    arrival. read() skips frames that grew old in the driver's queue. ``where`` is ``/dev/video0`` or ``0``; ``fps`` is
    the requested rate, ``self.fps`` the one that the camera reports.
    Raises UsageError for an odd width, SourceError if the device cannot be used or offers no such frames.
    """

    where: ClassVar[str] = "DEVICE"
    encoding: Encoding = "yuv422_yuy2"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:  # noqa: ARG002
        self._path = f"/dev/video{where}" if where.isdecimal() else where
        super().__init__(f"v4l2:{self._path}", width, height, even=True)
        _check_device(self._path)
        capture = self._capture = cv2.VideoCapture(self._path, cv2.CAP_V4L2)
        try:
            self._configure(capture, fps)
        except SourceError:
            self.close()
            raise
        self.fps = capture.get(cv2.CAP_PROP_FPS) or fps

    def _picture(self) -> Pixels:
        done, picture = self._capture.retrieve()
        if not done or picture.nbytes != self.width * self.height * 2:
            raise SourceError(
                f"`source`: {self._path} delivered {picture.nbytes if done else 'no'} bytes where "
                f"{self.width}x{self.height} YUYV has {self.width * self.height * 2}; try another cable, port or `size`"
            )
        return cast("Pixels", picture).reshape(self.height, self.width, 2)

    def close(self) -> None:
        super().close()
        self._capture.release()

    def _configure(self, capture: cv2.VideoCapture, fps: float) -> None:
        if not capture.isOpened():
            raise SourceError(
                f"`source`: cannot start {self._path}; `fuser -v {self._path}` shows whether another program uses it"
            )
        yuyv = cv2.VideoWriter.fourcc(*"YUYV")
        capture.set(cv2.CAP_PROP_FOURCC, yuyv)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.height)
        capture.set(cv2.CAP_PROP_FPS, fps)
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if (code, *size) != (yuyv, self.width, self.height):
            gives = code.to_bytes(4, "little", signed=code < 0).decode("ascii", "replace").strip("\0 ")
            raise SourceError(
                f"`source`: {self._path} gives {gives} {size[0]}x{size[1]}, not YUYV {self.width}x{self.height}; "
                f"`v4l2-ctl -d {self._path} --list-formats-ext` lists what it offers: choose a `size` from there"
            )

    def _grab(self) -> int:
        """Have the driver hand over a frame; return its time of capture."""
        for _ in range(QUEUE):
            began_ns = now_ns()
            if not self._capture.grab():
                raise SourceError(f"`source`: {self._path} delivers no frames; is it still plugged in?")
            arrived_ns = now_ns()
            driver_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            # a driver that stamps with another clock is decades off, one that does not stamp gives 0
            stamp_ns = driver_ns if 0 < driver_ns <= arrived_ns else arrived_ns
            waited = arrived_ns - began_ns > AT_ONCE_NS
            # a USB camera stamps a frame's start, so one that just arrived is about one period old
            if waited or arrived_ns - stamp_ns < 2e9 / self.fps:
                break
        return stamp_ns


def _check_device(path: str) -> None:
    """Raise SourceError unless ``path`` is a capture device that can be opened: OpenCV gives no reason."""
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except FileNotFoundError:
        raise SourceError(f"`source`: no camera at {path}; `ls /dev/video*` shows those there are") from None
    except PermissionError:
        raise SourceError(
            f"`source`: no permission to open {path}; `sudo usermod -aG video $USER` gives it from the next login on"
        ) from None
    except OSError as error:
        raise SourceError(f"`source`: cannot open {path}: {error.strerror}") from error
    try:
        _, caps = _card_and_caps(device, fcntl.ioctl)
    except OSError:
        raise SourceError(f"`source`: {path} is no camera; `ls /dev/video*` shows those there are") from None
    finally:
        os.close(device)
    if not caps & CAN_CAPTURE:
        raise SourceError(
            f"`source`: {path} captures no pictures, though its camera may under another number; "
            "`v4l2-ctl --list-devices` shows them"
        )


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """One capture device; ``problem`` is the reason if it cannot be examined."""

    path: str
    card: str = ""
    formats: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    """Four-letter code -> sizes; the smallest and the largest if they are a range."""
    problem: str = ""

    def summary(self) -> str:
        return ", ".join(
            f"{code} up to {max(sizes)[0]}x{max(sizes)[1]}" if sizes else code for code, sizes in self.formats.items()
        )


def list_cameras(folder: Path = Path("/dev"), ioctl: Ioctl = fcntl.ioctl) -> list[CameraInfo]:
    """Examine every ``video`` device; those that capture nothing (metadata, encoders) are left out."""
    paths = sorted(folder.glob("video[0-9]*"), key=lambda path: int(re.sub(r"\D", "", path.name)))
    return [camera for path in paths if (camera := _examine(path, ioctl)) is not None]


def _examine(path: Path, ioctl: Ioctl) -> CameraInfo | None:
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except PermissionError:
        return CameraInfo(str(path), problem="no permission to open it")
    except OSError as error:
        return CameraInfo(str(path), problem=error.strerror or str(error))
    try:
        card, caps = _card_and_caps(device, ioctl)
        if not caps & (CAN_CAPTURE | CAN_CAPTURE_PLANES):
            return None
        kind = CAPTURE if caps & CAN_CAPTURE else CAPTURE_PLANES
        return CameraInfo(str(path), card, _formats(device, kind, ioctl))
    except OSError:
        return None
    finally:
        os.close(device)


def _card_and_caps(device: int, ioctl: Ioctl) -> tuple[str, int]:
    _, card, _, _, all_caps, device_caps = CAPABILITY.unpack(ioctl(device, VIDIOC_QUERYCAP, bytes(CAPABILITY.size)))
    return _text(card), device_caps if all_caps & HAS_DEVICE_CAPS else all_caps


def _formats(device: int, kind: int, ioctl: Ioctl) -> dict[str, list[tuple[int, int]]]:
    formats = {}
    for index in range(MOST):
        try:
            answer = ioctl(device, VIDIOC_ENUM_FMT, FORMAT.pack(index, kind, 0, b"", 0))
        except OSError as error:
            if error.errno != errno.EINVAL:  # EINVAL: the end of the list
                raise
            break
        code: int = FORMAT.unpack(answer)[4]
        formats[_text(code.to_bytes(4, "little"))] = _sizes(device, code, ioctl)
    return formats


def _sizes(device: int, code: int, ioctl: Ioctl) -> list[tuple[int, int]]:
    sizes: list[tuple[int, int]] = []
    for index in range(MOST):
        try:
            answer = ioctl(device, VIDIOC_ENUM_FRAMESIZES, FRAME_SIZE.pack(index, code, 0, *[0] * 6))
        except OSError:
            break
        _, _, kind, *numbers = FRAME_SIZE.unpack(answer)
        if kind != DISCRETE:
            return [(numbers[0], numbers[3]), (numbers[1], numbers[4])]
        sizes.append((numbers[0], numbers[1]))
    return sizes


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("ascii", "replace").strip()
