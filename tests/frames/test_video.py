"""A video file as a camera."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from s2a_bench.errors import SourceError
from s2a_bench.frames.files import VideoFile
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource

GREYS = [40, 80, 120, 160]


@pytest.fixture
def clip(tmp_path: Path) -> str:
    """Four frames of 64x48, of one grey each."""
    path = str(tmp_path / "clip.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for grey in GREYS:
        writer.write(np.full((48, 64, 3), grey, np.uint8))
    writer.release()
    return path


class TestContract(FrameSourceSuite):
    @pytest.fixture
    def make_source(self, clip: str) -> MakeSource:
        return lambda width, height: VideoFile(clip, width, height)


@pytest.mark.parametrize("size", [(64, 48), (32, 24), (128, 96)])
def test_frames_come_in_order_and_start_over(clip: str, size: tuple[int, int]) -> None:
    source = VideoFile(clip, *size)
    seen = [source.read().data.mean() for _ in range(9)]
    np.testing.assert_allclose(seen, [*GREYS, *GREYS, GREYS[0]], atol=3)


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    path = tmp_path / "text.mp4"
    path.write_text("no video")
    with pytest.raises(SourceError, match=r"^`source`: .*text\.mp4 is not a video"):
        VideoFile(str(path), 64, 48)


def test_a_video_that_yields_no_frame_is_an_error_and_no_endless_loop(
    clip: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    barren = SimpleNamespace(isOpened=lambda: True, read=lambda: (False, None), release=lambda: None)
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: barren)
    with pytest.raises(SourceError, match=r"clip\.avi holds no frame"):
        VideoFile(clip, 64, 48).read()
