"""Real cameras through Linux' V4L2, as sources of their driver's YUYV."""

from __future__ import annotations

import fcntl
import os
import struct
from typing import ClassVar, cast

import cv2

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError
from s2a_bench.frames import NumberedSource
from s2a_bench.types import Encoding, Pixels

VIDIOC_QUERYCAP = 0x80685600
"""``linux/videodev2.h``: fill a struct v4l2_capability."""
CAPABILITY = struct.Struct("16s32s32sIII12x")
"""struct v4l2_capability: driver, card, bus, version, capabilities, device_caps, reserved."""
CAN_CAPTURE, HAS_DEVICE_CAPS = 0x00000001, 0x80000000
QUEUE = 10
"""The most buffers that OpenCV has a driver fill; its default is 4."""
AT_ONCE_NS = 1_000_000
"""A frame delivered faster than this was waiting in the queue."""


class V4L2Camera(NumberedSource):
    """A V4L2 capture device: (h, w, 2) ``yuv422_yuy2``, not converted.

    ``stamp_ns`` is the driver's time of capture if it stamps with CLOCK_MONOTONIC, as USB cameras do, else the time of
    arrival. read() skips frames that grew old in the driver's queue. ``self.fps`` is the rate that the camera reports.
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
        answer = fcntl.ioctl(device, VIDIOC_QUERYCAP, bytes(CAPABILITY.size))
    except OSError:
        raise SourceError(f"`source`: {path} is not a camera; `ls /dev/video*` shows those there are") from None
    finally:
        os.close(device)
    *_, all_caps, device_caps = CAPABILITY.unpack(answer)
    if not (device_caps if all_caps & HAS_DEVICE_CAPS else all_caps) & CAN_CAPTURE:
        raise SourceError(
            f"`source`: {path} captures no pictures, though its camera may under another number; "
            "`v4l2-ctl --list-devices` shows them"
        )
