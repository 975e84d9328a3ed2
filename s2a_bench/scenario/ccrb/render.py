"""Pictures of the three cars from above: highway-env's own drawing, without a screen."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench import extras
from s2a_bench.scenario import EGO, LEAD, REAR
from s2a_bench.scenario.roads import LANE_WIDTH_M, MIDDLE_M, build_road, centre

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats

COLOURS: Final = {LEAD: (230, 159, 0), EGO: (0, 158, 115), REAR: (0, 114, 178)}
CRASHED: Final = (213, 94, 0)
PIXELS_A_M: Final = 8.0
AHEAD_M: Final = 15.0
"""How far ahead of the ego the middle of the picture lies."""


class TopView:
    """Looks down on the road, and follows the ego."""

    def __init__(self, width: int, height: int) -> None:
        # pygame asks for its drivers when it is imported: none is there without a screen or loudspeaker.
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

    def picture(
        self, position_m: Floats, lateral_m: Floats, heading: Floats, crashed: frozenset[int] = frozenset()
    ) -> NDArray[np.uint8]:
        """Return RGB pixels, shape (height, width, 3), for arrays of shape (3,); headings in rad, to the left."""
        for car, vehicle in self._cars.items():
            vehicle.position = centre(car, float(position_m[car]), float(lateral_m[car]), vehicle.LENGTH)
            vehicle.heading = -float(heading[car])
            vehicle.color = CRASHED if car in crashed else COLOURS[car]
        middle = np.array([float(position_m[EGO]) + AHEAD_M, MIDDLE_M - LANE_WIDTH_M / 2])
        self._surface.move_display_window_to(middle)
        self._draw.display(self._road, self._surface)
        self._draw.display_traffic(self._road, self._surface, offscreen=True)
        return np.ascontiguousarray(self._pixels_of(self._surface).swapaxes(0, 1))
