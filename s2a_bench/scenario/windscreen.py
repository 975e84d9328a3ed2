"""The ego's view: pictures of the road and the lead from behind the windscreen, by day, drawn from a State."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from math import radians, tan
from typing import Final

import cv2
import numpy as np

from s2a_bench.frames import NumberedSource
from s2a_bench.policy import Floats
from s2a_bench.scenario import EGO, LANE_WIDTH_M, LEAD, State
from s2a_bench.types import Pixels

VIEW_DEG: Final = 60.0
"""Horizontal angle of view."""
HEIGHT_M, BEHIND_M = 1.3, 1.5
"""The camera above the road, and behind the ego's front bumper."""
NEAR_M, FAR_M = 0.6, 2000.0
LINE_M, DASH_M, DASHES_M, DASHED_TO_M = 0.15, 4.0, 12.0, 240.0
BRAKING_MPS2: Final = -0.7
"""Brake lights are lit below it (UN R13-H: they may be from 0.7 m/s^2, and have to be from 1.3 m/s^2)."""

SKY: Final = ((214, 160, 96), (240, 226, 206))
"""Above, and at the horizon; every colour is BGR."""
GRASS, ROAD, SHADOW, PAINT = (72, 122, 92), (98, 96, 94), (48, 46, 46), (236, 236, 236)
BODY, SIDE, GLASS, DARK = (0, 159, 230), (0, 112, 166), (70, 54, 40), (34, 32, 32)
LAMP, LIT = (24, 24, 120), (64, 48, 255)
CAR_M: Final = 4.4
CAR: Final = (
    (SHADOW, (-0.2, 4.6), (-1.0, 1.0), (0.0, 0.0)),
    (DARK, (0.4, 1.0), (-0.9, 0.9), (0.0, 0.4)),
    (SIDE, (0.0, CAR_M), (-0.9, 0.9), (0.28, 0.95)),
    (BODY, (0.0, 0.0), (-0.9, 0.9), (0.42, 0.95)),
    (DARK, (0.0, 0.0), (-0.9, 0.9), (0.28, 0.42)),
    (PAINT, (0.0, 0.0), (-0.26, 0.26), (0.5, 0.61)),
    (LAMP, (0.0, 0.0), (-0.89, -0.57), (0.68, 0.86)),
    (LAMP, (0.0, 0.0), (0.57, 0.89), (0.68, 0.86)),
    (SIDE, (0.5, 3.0), (-0.72, 0.72), (0.95, 1.42)),
    (BODY, (0.5, 0.5), (-0.72, 0.72), (0.95, 1.42)),
    (GLASS, (0.5, 0.5), (-0.62, 0.62), (1.0, 1.34)),
    (LAMP, (0.5, 0.5), (-0.25, 0.25), (1.36, 1.41)),
)
"""A car from behind: blocks in m ahead of its rear bumper, to its left, above the road; each covers those before."""


class Windscreen(NumberedSource):
    """A camera in the ego: (h, w, 3) ``bgr8``, drawn from the state of the cars at each `read`.

    ``now`` returns it with the accelerations in m/s^2, of shape (3, M), whose first roll-out is shown.
    """

    def __init__(self, now: Callable[[], tuple[State, Floats]], width: int, height: int) -> None:
        super().__init__("windscreen", width, height)
        self._now = now
        self._empty = np.full((height, width, 3), GRASS, np.uint8)
        self._empty[: height // 2] = np.linspace(*SKY, height // 2)[:, np.newaxis]

    def _picture(self) -> Pixels:
        state, acceleration = self._now()
        picture = self._empty.copy()
        eye_m, aside_m = state.position_m[EGO, 0] - BEHIND_M, state.lateral_m[EGO, 0]
        right, left = -LANE_WIDTH_M / 2 - aside_m, LANE_WIDTH_M * 1.5 - aside_m
        _fill(picture, ROAD, (NEAR_M, FAR_M), (right - 1.0, left + 1.0))
        for line in (right, left):
            _fill(picture, PAINT, (NEAR_M, FAR_M), (line, line + LINE_M))
        for start in np.arange(-eye_m % DASHES_M - DASHES_M, DASHED_TO_M, DASHES_M):
            _fill(picture, PAINT, (start, start + DASH_M), (right + LANE_WIDTH_M, right + LANE_WIDTH_M + LINE_M))
        at, aside, lit = state.position_m[LEAD, 0] - eye_m, state.lateral_m[LEAD, 0] - aside_m, acceleration[LEAD, 0]
        for colour, ahead, across, up in CAR if at + CAR_M > NEAR_M else ():
            shown = LIT if colour == LAMP and lit < BRAKING_MPS2 else colour
            _fill(picture, shown, np.add(ahead, at), np.add(across, aside), up)
        return picture


def _fill(picture: Pixels, colour: tuple[int, ...], ahead: object, across: object, up: object = (0.0, 0.0)) -> None:
    """Fill the outline of a block, given as pairs (from, to) in m ahead of the camera, to its left, above the road."""
    x, y, z = np.array(list(product(ahead, across, up))).T  # type: ignore[call-overload]
    if x.max() > NEAR_M:
        height, width = picture.shape[:2]
        scale = width / 2 / tan(radians(VIEW_DEG / 2)) / np.maximum(x, NEAR_M)
        corners = np.stack([width / 2 - y * scale, height / 2 + (HEIGHT_M - z) * scale], axis=1)
        outline = cv2.convexHull(np.rint(corners * 16).astype(np.int32))  # in 1/16 pixels, as shift=4 says
        cv2.fillConvexPoly(picture, outline, colour, cv2.LINE_AA, shift=4)
