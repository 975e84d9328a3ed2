"""The conformance suite of frame sources."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np
import pytest

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import FrameSource

MakeSource: TypeAlias = Callable[[int, int], FrameSource]
CHANNELS = {"yuv422_yuy2": (2,), "bgr8": (3,), "rgb8": (3,), "bgra8": (4,), "rgba8": (4,), "mono8": ()}
SIZES = [(64, 48), (98, 30)]


class FrameSourceSuite:
    """Fixture: ``make_source`` opens a new source with this width and height; its frames differ.

    It raises UsageError for a size without pixels.
    """

    @pytest.fixture
    def source(self, make_source: MakeSource) -> Iterator[FrameSource]:
        source = make_source(*SIZES[0])
        yield source
        source.close()

    @pytest.mark.parametrize("size", SIZES)
    def test_frames_have_the_size_and_encoding_asked_for(self, make_source: MakeSource, size: tuple[int, int]) -> None:
        source = make_source(*size)
        assert (source.width, source.height) == size
        for _ in range(3):
            frame = source.read()
            assert (frame.width, frame.height, frame.encoding) == (*size, source.encoding)
            assert frame.data.dtype == np.uint8
            assert frame.data.shape == (size[1], size[0], *CHANNELS[frame.encoding])
            assert frame.data.flags.c_contiguous
        source.close()

    def test_its_kind_says_what_to_write_after_its_name(self, source: FrameSource) -> None:
        assert isinstance(type(source).where, str)  # type: ignore[attr-defined]  # of SourceKind

    def test_it_has_a_name(self, source: FrameSource) -> None:
        assert source.name

    def test_frames_count_from_zero(self, source: FrameSource) -> None:
        assert [source.read().index for _ in range(5)] == [0, 1, 2, 3, 4]

    def test_stamps_are_readings_of_the_monotonic_clock_in_order(self, make_source: MakeSource) -> None:
        before = now_ns()
        source = make_source(*SIZES[0])
        stamps = [source.read().stamp_ns for _ in range(5)]
        assert before <= stamps[0]
        assert stamps == sorted(stamps)
        assert stamps[-1] <= now_ns()
        source.close()

    def test_a_frame_stays_as_it_was_while_more_are_read(self, source: FrameSource) -> None:
        frames = [source.read() for _ in range(3)]
        copies = [frame.data.copy() for frame in frames]
        for _ in range(20):
            source.read()
        for frame, copy in zip(frames, copies, strict=True):
            np.testing.assert_array_equal(frame.data, copy)

    def test_writing_into_a_frame_never_shows_in_another(self, source: FrameSource) -> None:
        graffito = np.random.default_rng(5).integers(0, 256, source.read().data.shape, np.uint8)
        for _ in range(30):
            data = source.read().data
            assert np.mean(data == graffito) < 0.5
            data[:] = graffito

    def test_frames_outlive_the_source(self, source: FrameSource) -> None:
        frame = source.read()
        copy = frame.data.copy()
        source.close()
        np.testing.assert_array_equal(frame.data, copy)

    def test_closing_twice_is_fine(self, source: FrameSource) -> None:
        source.close()
        source.close()

    def test_reading_after_close_says_so(self, source: FrameSource) -> None:
        source.read()
        source.close()
        with pytest.raises(SourceError, match=r"^`source`: .*closed"):
            source.read()

    @pytest.mark.parametrize("size", [(0, 48), (64, 0), (-2, 48)])
    def test_a_size_without_pixels_is_refused(self, make_source: MakeSource, size: tuple[int, int]) -> None:
        with pytest.raises(UsageError, match="`size`"):
            make_source(*size)
