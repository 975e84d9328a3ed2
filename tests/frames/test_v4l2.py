"""The V4L2 camera against a stand-in for OpenCV's, for want of a device; missing and wrong devices are real."""

from __future__ import annotations

import fcntl
import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from s2a_bench.clock import VirtualClock
from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import v4l2
from s2a_bench.frames.v4l2 import CAN_CAPTURE, CAPABILITY, HAS_DEVICE_CAPS, V4L2Camera
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource

MS = 1_000_000
YUYV, MJPG = (cv2.VideoWriter.fourcc(*code) for code in ("YUYV", "MJPG"))


@dataclass
class Driver:
    """A camera's behaviour: what it refuses, and the stamps of the frames it has ready."""

    busy: bool = False
    forced: dict[int, float] = field(default_factory=dict)
    unplugged: bool = False
    layout: tuple[int, ...] | None = None
    stamps_ms: list[float] = field(default_factory=list)
    opened: list[tuple[str, int]] = field(default_factory=list)
    settings: dict[int, float] = field(default_factory=dict)
    released: int = 0
    grabs: int = 0


class Capture:
    """Stands in for cv2.VideoCapture on a V4L2 device."""

    def __init__(self, driver: Driver, path: str, backend: int) -> None:
        self.driver, self.open = driver, not driver.busy
        driver.opened.append((path, backend))
        # as OpenCV opens a camera before anything is set
        self.properties: dict[int, float] = {cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480}

    def isOpened(self) -> bool:  # noqa: N802
        return self.open

    def set(self, key: int, value: float) -> bool:
        self.driver.settings[key] = value
        self.properties[key] = value
        return True

    def get(self, key: int) -> float:
        if key == cv2.CAP_PROP_POS_MSEC:
            stamps = self.driver.stamps_ms
            return stamps[min(self.driver.grabs, len(stamps)) - 1] if stamps else 0.0
        return self.driver.forced.get(key, self.properties.get(key, 0.0))

    def grab(self) -> bool:
        self.driver.grabs += 1
        return not self.driver.unplugged

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        width, height = (int(self.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        shape = self.driver.layout or (height, width, 2)
        return True, np.full(shape, self.driver.grabs, np.uint8)

    def release(self) -> None:
        self.open = False
        self.driver.released += 1


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    """Put a stand-in device behind every path."""
    driver = Driver()
    monkeypatch.setattr(cv2, "VideoCapture", lambda path, backend: Capture(driver, path, backend))
    monkeypatch.setattr(v4l2, "_check_device", lambda path: None)  # noqa: ARG005
    return driver


class TestContract(FrameSourceSuite):
    @pytest.fixture
    def make_source(self, driver: Driver) -> MakeSource:
        def make(width: int, height: int) -> V4L2Camera:
            driver.grabs = 0
            return V4L2Camera("/dev/video0", width, height)

        return make


def test_it_asks_for_unconverted_yuyv_at_the_rate(driver: Driver) -> None:
    camera = V4L2Camera("/dev/video0", 320, 240, fps=15)
    assert driver.opened == [("/dev/video0", cv2.CAP_V4L2)]
    assert driver.settings == {
        cv2.CAP_PROP_FOURCC: YUYV,
        cv2.CAP_PROP_FRAME_WIDTH: 320,
        cv2.CAP_PROP_FRAME_HEIGHT: 240,
        cv2.CAP_PROP_FPS: 15,
        cv2.CAP_PROP_CONVERT_RGB: 0,
    }
    assert (camera.name, camera.fps) == ("v4l2:/dev/video0", 15)
    driver.forced[cv2.CAP_PROP_FPS] = 25
    camera = V4L2Camera("2", 64, 48, fps=30)
    assert (camera.name, camera.fps, driver.opened[-1][0]) == ("v4l2:/dev/video2", 25, "/dev/video2")


def test_flat_data_gets_its_shape_and_what_is_no_frame_is_an_error(driver: Driver) -> None:
    camera = V4L2Camera("0", 64, 48)
    driver.layout = (1, 64 * 48 * 2)
    assert camera.read().data.shape == (48, 64, 2)
    driver.layout = (1, 100)
    with pytest.raises(SourceError, match=r"delivered 100 bytes where 64x48 YUYV has 6144"):
        camera.read()
    driver.unplugged = True
    with pytest.raises(SourceError, match="/dev/video0 delivers no frames"):
        camera.read()


def test_a_busy_device_is_named(driver: Driver) -> None:
    driver.busy = True
    with pytest.raises(SourceError, match=r"^`source`: cannot start /dev/video0; `fuser"):
        V4L2Camera("0", 64, 48)


@pytest.mark.parametrize(
    ("forced", "gives"),
    [
        ({cv2.CAP_PROP_FOURCC: MJPG}, "MJPG 64x48"),
        ({cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480}, "YUYV 640x480"),
    ],
)
def test_a_camera_without_the_format_says_what_it_gives(driver: Driver, forced: dict[int, float], gives: str) -> None:
    driver.forced = forced
    with pytest.raises(SourceError, match=f"gives {gives}, not YUYV 64x48; .*list-formats-ext"):
        V4L2Camera("0", 64, 48)
    assert driver.released == 1


def test_an_odd_width_is_refused() -> None:
    with pytest.raises(UsageError, match="`size`: 65x48"):
        V4L2Camera("0", 65, 48)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    """Let the camera's clock stand at ten seconds."""
    clock = VirtualClock(10_000 * MS)
    monkeypatch.setattr(v4l2, "now_ns", clock.now_ns)
    return clock


@pytest.mark.usefixtures("clock")
def test_the_drivers_stamp_is_taken_where_it_is_monotonic(driver: Driver) -> None:
    driver.stamps_ms = [9_970.125]
    assert V4L2Camera("0", 64, 48).read().stamp_ns == 9_970_125_000


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("stamp_ms", [0.0, -1.0, 1.7e12])
def test_a_stamp_of_another_clock_gives_way_to_the_time_of_arrival(driver: Driver, stamp_ms: float) -> None:
    driver.stamps_ms = [stamp_ms]
    assert V4L2Camera("0", 64, 48).read().stamp_ns == 10_000 * MS
    assert driver.grabs == 1


@pytest.mark.usefixtures("clock")
def test_frames_that_grew_old_in_the_queue_are_passed_over(driver: Driver) -> None:
    driver.stamps_ms = [7_000, 7_033, 7_066, 9_980, 9_999]
    frame = V4L2Camera("0", 64, 48).read()
    assert frame.stamp_ns == 9_980 * MS
    assert (frame.index, frame.data[0, 0, 0]) == (0, 4)


@pytest.mark.usefixtures("clock")
def test_a_camera_whose_frames_are_always_old_is_not_drained_for_ever(driver: Driver) -> None:
    driver.stamps_ms = [1_000]
    V4L2Camera("0", 64, 48).read()
    assert driver.grabs == v4l2.QUEUE


def test_a_frame_that_had_to_be_waited_for_is_fresh_whatever_its_stamp(
    driver: Driver, clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver.stamps_ms = [9_000]
    camera = V4L2Camera("0", 64, 48)
    grab = camera._capture.grab

    def slow_grab() -> bool:
        clock.sleep_until_ns(clock.now_ns() + 20 * MS)
        return grab()

    monkeypatch.setattr(camera._capture, "grab", slow_grab)
    assert camera.read().stamp_ns == 9_000 * MS
    assert driver.grabs == 1


def test_what_is_no_camera_is_named_without_noise(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.touch()
    for path, says in {
        "/dev/video99": "no camera at /dev/video99; `ls /dev/video",
        "/dev/null": "/dev/null is not a camera",
        str(file): f"{file} is not a camera",
        str(tmp_path): ".*Is a directory",
    }.items():
        with pytest.raises(SourceError, match=f"^`source`: {says}"):
            V4L2Camera(path, 64, 48)
    assert capfd.readouterr() == ("", "")


def test_a_device_one_may_not_open_says_how_to_get_the_right(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(SourceError, match="no permission to open /dev/video0; `sudo usermod -aG video"):
        V4L2Camera("0", 64, 48)


META_ONLY = 0x00800000


@pytest.mark.parametrize(
    ("all_caps", "device_caps", "captures"),
    [
        (HAS_DEVICE_CAPS | CAN_CAPTURE | META_ONLY, CAN_CAPTURE, True),
        (HAS_DEVICE_CAPS | CAN_CAPTURE | META_ONLY, META_ONLY, False),
        (CAN_CAPTURE, 0, True),
        (META_ONLY, 0, False),
    ],
)
def test_a_cameras_metadata_device_is_told_from_its_pictures(
    monkeypatch: pytest.MonkeyPatch, all_caps: int, device_caps: int, captures: bool
) -> None:
    answer = CAPABILITY.pack(b"uvcvideo", b"Camera", b"usb-1", 0, all_caps, device_caps)
    monkeypatch.setattr(fcntl, "ioctl", lambda *_: answer)
    if captures:
        v4l2._check_device("/dev/null")
    else:
        with pytest.raises(SourceError, match="/dev/null captures no pictures"):
            v4l2._check_device("/dev/null")
