"""Formats and sizes of cameras, from a stand-in for the kernel's V4L2."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.frames.v4l2 import (
    CAN_CAPTURE,
    CAN_CAPTURE_PLANES,
    CAPABILITY,
    FORMAT,
    FRAME_SIZE,
    HAS_DEVICE_CAPS,
    VIDIOC_ENUM_FMT,
    VIDIOC_ENUM_FRAMESIZES,
    VIDIOC_QUERYCAP,
    CameraInfo,
    list_cameras,
)

METADATA = 0x00800000


def iowr(number: int, size: int) -> int:
    """Compute _IOWR('V', number, ...) of asm-generic/ioctl.h."""
    return 3 << 30 | size << 16 | ord("V") << 8 | number


class Driver:
    """Answers for one camera; ``caps`` by device name."""

    def __init__(self, formats: dict[str, list[tuple[int, ...]]], caps: int = CAN_CAPTURE) -> None:
        self.formats, self.caps = formats, caps

    def __call__(self, _device: int, request: int, data: bytes) -> bytes:
        if request == VIDIOC_QUERYCAP:
            return CAPABILITY.pack(b"uvcvideo", b"HD Webcam\0junk", b"usb", 1, HAS_DEVICE_CAPS | METADATA, self.caps)
        if request == VIDIOC_ENUM_FMT:
            index, kind, *_ = FORMAT.unpack(data)
            assert kind == (1 if self.caps & CAN_CAPTURE else 9)
            return FORMAT.pack(
                index, kind, 0, b"some", int.from_bytes(self._at(list(self.formats), index).encode(), "little")
            )
        assert request == VIDIOC_ENUM_FRAMESIZES
        index, code, *_ = FRAME_SIZE.unpack(data)
        size = self._at(self.formats[code.to_bytes(4, "little").decode()], index)
        discrete = len(size) == 2
        return FRAME_SIZE.pack(index, code, 1 if discrete else 3, *size, *[0] * (6 - len(size)))

    @staticmethod
    def _at(values: list[Any], index: int) -> Any:
        if index >= len(values):
            raise OSError(errno.EINVAL, "no more")
        return values[index]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "video0").touch()
    (tmp_path / "videotape").touch()
    return tmp_path


def test_the_request_codes_are_the_kernels() -> None:
    assert iowr(2, FORMAT.size) == VIDIOC_ENUM_FMT
    assert iowr(74, FRAME_SIZE.size) == VIDIOC_ENUM_FRAMESIZES


def test_formats_come_with_their_sizes(folder: Path) -> None:
    formats: dict[str, list[tuple[int, ...]]] = {"YUYV": [(640, 480), (1280, 720)], "MJPG": [(1920, 1080)], "H264": []}
    (camera,) = list_cameras(folder, Driver(formats))
    assert camera == CameraInfo(str(folder / "video0"), "HD Webcam", formats)  # type: ignore[arg-type]
    assert camera.summary() == "YUYV up to 1280x720, MJPG up to 1920x1080, H264"


def test_a_range_of_sizes_is_its_ends(folder: Path) -> None:
    (camera,) = list_cameras(folder, Driver({"NV12": [(64, 4096, 2, 48, 2160, 2)]}, CAN_CAPTURE_PLANES))
    assert camera.formats == {"NV12": [(64, 48), (4096, 2160)]}


def test_cameras_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 0):
        (tmp_path / f"video{number}").touch()
    found = list_cameras(tmp_path, Driver({"YUYV": []}))
    assert [Path(camera.path).name for camera in found] == ["video0", "video2", "video10"]


def test_what_captures_nothing_is_no_camera(folder: Path) -> None:
    assert list_cameras(folder, Driver({}, METADATA)) == []


def test_a_file_that_is_no_device_is_no_camera(folder: Path) -> None:
    assert list_cameras(folder) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_camera_that_may_not_be_opened_is_listed_with_the_reason(folder: Path) -> None:
    (folder / "video0").chmod(0)
    (camera,) = list_cameras(folder)
    assert "no permission" in camera.problem


def test_a_driver_that_never_ends_is_cut_off(folder: Path) -> None:
    class Endless(Driver):
        @staticmethod
        def _at(values: list[Any], index: int) -> Any:
            return values[index % len(values)]

    (camera,) = list_cameras(folder, Endless({"YUYV": [(640, 480)]}))
    assert len(camera.formats["YUYV"]) == 64
