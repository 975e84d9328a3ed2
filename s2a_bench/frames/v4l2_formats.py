"""Which cameras there are and what they offer, asked of Linux' V4L2 without starting them."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from s2a_bench.frames.v4l2 import CAN_CAPTURE, CAPABILITY, HAS_DEVICE_CAPS, VIDIOC_QUERYCAP

VIDIOC_ENUM_FMT = 0xC0405602
VIDIOC_ENUM_FRAMESIZES = 0xC02C564A
"""``linux/videodev2.h``: fill a struct v4l2_fmtdesc, v4l2_frmsizeenum."""
FORMAT = struct.Struct("III32sI16x")
"""struct v4l2_fmtdesc: index, type, flags, description, pixelformat, mbus_code and reserved."""
FRAME_SIZE = struct.Struct("III6I8x")
"""struct v4l2_frmsizeenum: index, pixel_format, type, then width and height, or both as minimum, maximum, step."""
CAN_CAPTURE_PLANES = 0x00001000
CAPTURE, CAPTURE_PLANES = 1, 9
DISCRETE = 1
MOST = 64
"""Entries of a list that are asked for; a driver that never says "no more" is cut off."""

Ioctl = Callable[[int, int, bytes], bytes]


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """One capture device; ``problem`` says why nothing is known of it."""

    path: str
    card: str = ""
    formats: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    """Four-letter code -> sizes; of a range of sizes the smallest and the largest."""
    problem: str = ""

    def summary(self) -> str:
        """Say each format with its largest size."""
        return ", ".join(
            f"{code} up to {max(sizes)[0]}x{max(sizes)[1]}" if sizes else code for code, sizes in self.formats.items()
        )


def list_cameras(folder: Path = Path("/dev"), ioctl: Ioctl = fcntl.ioctl) -> list[CameraInfo]:
    """Look at every ``video`` device; those that capture nothing (metadata, encoders) are left out."""
    paths = sorted(folder.glob("video[0-9]*"), key=lambda path: int(re.sub(r"\D", "", path.name)))
    return [camera for path in paths if (camera := _look(path, ioctl)) is not None]


def _look(path: Path, ioctl: Ioctl) -> CameraInfo | None:
    """Ask one device; None if it is no camera."""
    try:
        device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except PermissionError:
        return CameraInfo(str(path), problem="no permission to open it")
    except OSError as error:
        return CameraInfo(str(path), problem=error.strerror or str(error))
    try:
        _, card, _, _, all_caps, device_caps = CAPABILITY.unpack(ioctl(device, VIDIOC_QUERYCAP, bytes(CAPABILITY.size)))
        caps = device_caps if all_caps & HAS_DEVICE_CAPS else all_caps
        if not caps & (CAN_CAPTURE | CAN_CAPTURE_PLANES):
            return None
        kind = CAPTURE if caps & CAN_CAPTURE else CAPTURE_PLANES
        return CameraInfo(str(path), _text(card), _formats(device, kind, ioctl))
    except OSError:
        return None
    finally:
        os.close(device)


def _formats(device: int, kind: int, ioctl: Ioctl) -> dict[str, list[tuple[int, int]]]:
    """List the pixel formats with their sizes."""
    formats = {}
    for index in range(MOST):
        try:
            answer = ioctl(device, VIDIOC_ENUM_FMT, FORMAT.pack(index, kind, 0, b"", 0))
        except OSError as error:
            if error.errno != errno.EINVAL:  # EINVAL: no more of them
                raise
            break
        code: int = FORMAT.unpack(answer)[4]
        formats[_text(code.to_bytes(4, "little"))] = _sizes(device, code, ioctl)
    return formats


def _sizes(device: int, code: int, ioctl: Ioctl) -> list[tuple[int, int]]:
    """List the sizes of a format; a driver need not know them."""
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
