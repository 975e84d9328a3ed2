"""The scene before the lead brakes, as a camera's frames: what a model is shown of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.clock import now_ns
from s2a_bench.frames import check_size
from s2a_bench.scenario import LEAD, REAR
from s2a_bench.scenario.ccrb.render import TopView
from s2a_bench.types import Encoding, Frame

if TYPE_CHECKING:
    from s2a_bench.scenario.ccrb.cars import Cars

LOOP_FRAMES: Final = 1000
"""After so many frames the cars are back where they began: a road has an end."""


class RoadSource:
    """A FrameSource of a single scenario, seen from above as in the animation, the ego and what is round it.

    All three drive on at v0 with the gaps that they have at t = 0; every frame is one period further down the road.
    read() renders and never waits. Raises UsageError for a tiny size.
    """

    encoding: Encoding = "rgb8"
    name = "scenario"

    def __init__(self, cars: Cars, width: int, height: int, *, fps: float = 30.0) -> None:
        """Draw once, as the first picture takes longer."""
        check_size(width, height, smallest=16)
        self.width, self.height = width, height
        self._view = TopView(width, height)
        self._gaps_m = np.zeros(3)
        self._gaps_m[LEAD], self._gaps_m[REAR] = float(cars.front_gap_m), -float(cars.rear_gap_m)  # type: ignore[arg-type]
        self._ahead_m = float(cars.speed_mps) / fps  # type: ignore[arg-type]
        self._index = 0
        self._picture(0)

    def read(self) -> Frame:
        """Render the next frame."""
        stamp_ns = now_ns()
        index = self._index
        self._index += 1
        return Frame(index, stamp_ns, self.width, self.height, self.encoding, self._picture(index))

    def close(self) -> None:
        """Hold nothing: the surface is memory."""

    def _picture(self, index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        """Return the pixels of a frame."""
        flat = np.zeros(3)
        return self._view.picture(self._gaps_m + self._ahead_m * (index % LOOP_FRAMES), flat, flat)
