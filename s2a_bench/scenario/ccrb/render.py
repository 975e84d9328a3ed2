"""Pictures of the three cars from above, by highway-env without a screen, and a source of such frames for a model."""

from __future__ import annotations

import os
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench import extras
from s2a_bench.clock import now_ns
from s2a_bench.frames import check_size
from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LEAD, REAR
from s2a_bench.scenario.ccrb.cars import Cars
from s2a_bench.scenario.embedded import LANE_WIDTH_M, MIDDLE_M, build_road, centre
from s2a_bench.types import Encoding, Frame

COLOURS: Final = {LEAD: (230, 159, 0), EGO: (0, 158, 115), REAR: (0, 114, 178)}
PIXELS_A_M: Final = 8.0
AHEAD_M: Final = 15.0
"""From the ego to the middle of the picture."""
LOOP_FRAMES: Final = 1000
"""The cars return to their start after this many frames, because the road is finite."""


class TopView:
    """A view of the road from above that follows the ego."""

    def __init__(self, width: int, height: int) -> None:
        # pygame selects its drivers at import; without a screen or loudspeaker only dummies work.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        pygame = extras.require("pygame", "ccrb")
        graphics = extras.require("highway_env.road.graphics", "ccrb")
        vehicles = extras.require("highway_env.vehicle.kinematics", "ccrb")
        self._pixels_of = pygame.surfarray.array3d
        self._draw: Any = graphics.RoadGraphics
        self._surface: Any = graphics.WorldSurface((width, height), 0, pygame.Surface((width, height)))
        self._surface.scaling = PIXELS_A_M
        self._road = build_road()
        self._cars: dict[int, Any] = {}
        for car, colour in COLOURS.items():
            vehicle = vehicles.Vehicle(self._road, centre(car, 0.0, 0.0, vehicles.Vehicle.LENGTH))
            vehicle.color = colour
            self._cars[car] = vehicle
            self._road.vehicles.append(vehicle)

    def picture(self, position_m: Floats) -> NDArray[np.uint8]:
        """Return RGB pixels, shape (height, width, 3), for positions of shape (3,)."""
        for car, vehicle in self._cars.items():
            vehicle.position = centre(car, float(position_m[car]), 0.0, vehicle.LENGTH)
        middle = np.array([float(position_m[EGO]) + AHEAD_M, MIDDLE_M - LANE_WIDTH_M / 2])
        self._surface.move_display_window_to(middle)
        self._draw.display(self._road, self._surface)
        self._draw.display_traffic(self._road, self._surface, offscreen=True)
        return np.ascontiguousarray(self._pixels_of(self._surface).swapaxes(0, 1))


class RoadSource:
    """A FrameSource of one scenario: the ego and its surroundings from above.

    All cars drive at v0 with their gaps at t = 0; every frame is one period later. `read` renders and never waits.
    Raises UsageError for a tiny size.
    """

    encoding: Encoding = "rgb8"
    name = "scenario"

    def __init__(self, cars: Cars, width: int, height: int, *, fps: float = 30.0) -> None:
        check_size(width, height, smallest=16)
        self.width, self.height = width, height
        self._view = TopView(width, height)
        self._gaps_m = np.zeros(3)
        self._gaps_m[LEAD], self._gaps_m[REAR] = float(cars.front_gap_m), -float(cars.rear_gap_m)  # type: ignore[arg-type]
        self._ahead_m = float(cars.speed_mps) / fps  # type: ignore[arg-type]
        self._index = 0
        self._picture(0)  # the first picture takes longer

    def read(self) -> Frame:
        stamp_ns = now_ns()
        index = self._index
        self._index += 1
        return Frame(index, stamp_ns, self.width, self.height, self.encoding, self._picture(index))

    def close(self) -> None: ...

    def _picture(self, index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        return self._view.picture(self._gaps_m + self._ahead_m * (index % LOOP_FRAMES))
