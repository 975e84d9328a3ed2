"""Frames for requests, and the running camera on a virtual clock."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from s2a_bench.clock import VirtualClock
from s2a_bench.errors import SourceError
from s2a_bench.frames import open_source
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.feed import Camera, RequestFeed
from s2a_bench.harness.pixels import fingerprint
from s2a_bench.trace import Trace
from s2a_bench.types import Frame


class Source:
    """Delivers numbered frames, slowly for some, and fails after the last."""

    name = "test"
    encoding = "bgr8"
    width = 16
    height = 16

    def __init__(self, clock: VirtualClock, frames: int, slow: dict[int, int] | None = None) -> None:
        self.clock = clock
        self.left = frames
        self.slow = slow or {}
        self.index = -1

    def read(self) -> Frame:
        self.index += 1
        if self.index >= self.left:
            raise SourceError("--source: no more")
        stamp_ns = self.clock.now_ns()
        self.clock.sleep_until_ns(stamp_ns + self.slow.get(self.index, 0))
        return Frame(self.index, stamp_ns, 16, 16, "bgr8", np.full((16, 16, 3), self.index, np.uint8))

    def close(self) -> None:
        pass


class Sink:
    """Packs, and names frames by their index."""

    def stamp_ns(self, frame: Frame) -> int:
        return 1_000 + frame.index

    def publish(self, frame: Frame, trace: Trace) -> None:
        del frame
        trace.mark("cdr_pack")


def run(frames: int, slow: dict[int, int] | None = None) -> Camera:
    """Run a camera at 10 Hz to its source's end."""
    clock = VirtualClock()
    camera = Camera(Source(clock, frames, slow), 10.0, clock)  # type: ignore[arg-type]
    camera.start()
    camera._thread.join(20)
    return camera


def test_the_camera_keeps_its_ticks_when_a_frame_is_late() -> None:
    frames = run(4, slow={1: 150_000_000}).drain()
    assert [frame.intended_ns for frame in frames] == [0, 100_000_000, 200_000_000, 300_000_000]
    assert [frame.captured_ns for frame in frames] == [0, 100_000_000, 250_000_000, 300_000_000]


def test_what_ends_the_camera_reaches_who_waits() -> None:
    camera = run(2)
    with pytest.raises(SourceError, match="no more"):
        camera.next_frame(5)


def test_frames_are_drained_once() -> None:
    camera = run(3)
    assert len(camera.drain()) == 3
    assert camera.drain() == []


def test_a_camera_that_stalls_is_an_error_not_an_old_frame() -> None:
    clock = VirtualClock()
    camera = Camera(Source(clock, 0), 10.0, clock)  # type: ignore[arg-type]  # never started
    with pytest.raises(SourceError, match="delivered nothing"):
        camera.next_frame(-1, timeout_s=0.01)


def test_changing_the_sink_forgets_the_frames_of_the_other() -> None:
    camera = run(3)
    camera.use(Sink())
    assert camera.newest is None
    assert camera.drain() == []


def test_a_published_frame_has_its_stamp() -> None:
    clock = VirtualClock()
    camera = Camera(Source(clock, 2), 10.0, clock)  # type: ignore[arg-type]
    camera.use(Sink())
    camera.start()
    camera._thread.join(20)
    frames = camera.drain()
    assert [frame.stamp_ns for frame in frames] == [1_000, 1_001]
    assert [stage for stage, _ in frames[0].marks] == ["", "capture", "cdr_pack"]


def test_a_request_captures_its_own_frame() -> None:
    feed = RequestFeed(Stamped(open_source("synthetic", 64, 48), ""), preencoded=False)
    traces = [Trace(), Trace()]
    frames = [frame for trace in traces for frame in feed.capture(trace)]
    assert [frame.index for frame in frames] == [0, 1]
    assert [stage for stage, _ in traces[0].marks] == ["", "capture"]
    assert fingerprint(frames[0].data) != fingerprint(frames[1].data)


def test_a_preencoded_frame_is_a_jpeg_made_before_the_clock_starts() -> None:
    feed = RequestFeed(open_source("synthetic", 64, 48), preencoded=True)
    feed.get_ready()
    (frame,) = feed.capture(Trace())
    assert frame.encoding == "jpeg"
    assert cv2.imdecode(frame.data, cv2.IMREAD_COLOR).shape == (48, 64, 3)
