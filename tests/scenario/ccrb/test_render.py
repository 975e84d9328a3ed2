"""The scene as a camera's frames: repeatable, each another, with the three cars in it."""

from __future__ import annotations

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.scenario.ccrb.cars import Cars
from s2a_bench.scenario.ccrb.render import COLOURS, RoadSource


def test_frames_differ_and_two_sources_deliver_the_same_ones() -> None:
    one, other = (RoadSource(Cars(), 320, 64) for _ in range(2))
    frames, again = [one.read() for _ in range(3)], [other.read() for _ in range(3)]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert {(frame.width, frame.height, frame.encoding) for frame in frames} == {(320, 64, "rgb8")}
    for frame, same in zip(frames, again, strict=True):
        assert frame.data.shape == (64, 320, 3)
        assert np.array_equal(frame.data, same.data)
    assert len({frame.data.tobytes() for frame in frames}) == 3


def test_the_cars_stand_at_their_gaps() -> None:
    data = RoadSource(Cars(front_gap_m=20.0, rear_gap_m=10.0), 640, 96).read().data
    left = {car: int(np.argwhere((data == colour).all(axis=2))[:, 1].min()) for car, colour in COLOURS.items()}
    lead, ego, rear = (left[car] for car in sorted(left))
    # 8 pixels a metre; cars are 5 m long, and gaps are from bumper to bumper.
    assert (lead - ego, ego - rear) == pytest.approx((8 * 25, 8 * 15), abs=2)


def test_a_tiny_size_is_refused() -> None:
    with pytest.raises(UsageError, match="`size`: 8x8 should be 16x16 or more"):
        RoadSource(Cars(), 8, 8)
