"""A camera without a camera: deterministic YUYV frames with the statistics of natural pictures.

The scene is rendered when the camera is made, larger than a frame; a frame is a window of it that moves along
a Lissajous curve. So capture costs one copy, as from a driver's buffer, and what is measured is the transport.

The scene consists of "dead leaves": opaque shapes with power-law sizes hide one another, which gives the edges and the
spectrum of natural pictures (Lee, Mumford and Huang, 2001, doi:10.1023/A:1011109015675). Noise of every scale textures
the surfaces, a slight blur models the lens, and white noise the sensor.
"""

from __future__ import annotations

import math
from typing import ClassVar, TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from s2a_bench.errors import UsageError
from s2a_bench.frames import NumberedSource
from s2a_bench.types import Encoding, Pixels

Plane: TypeAlias = NDArray[np.float32]

PERIODS_S = (11.0, 7.0)
"""Periods of the window's motion, across and down; coprime, so the path closes after 77 s only."""


class SyntheticCamera(NumberedSource):
    """A window moving over a rendered scene: (h, w, 2) ``yuv422_yuy2``.

    ``fps`` sets how far the window moves between two frames. The noise moves with the scene, unlike a sensor's, which
    is new in every frame.
    """

    where: ClassVar[str] = ""
    encoding: Encoding = "yuv422_yuy2"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:
        super().__init__(f"synthetic:{where}" if where else "synthetic", width, height, smallest=16, even=True)
        if not fps > 0:
            raise UsageError(f"`fps`: {fps} should be above 0")
        self.fps = fps
        # a quarter of the frame each way is enough for the motion, and soon rendered
        self._margin = (width // 8 * 2, height // 4)
        self._scene = render_scene(width + self._margin[0], height + self._margin[1], seed)

    def _picture(self) -> Pixels:
        t_s = self._index / self.fps
        across, down = (0.5 + 0.5 * math.sin(math.tau * t_s / period_s) for period_s in PERIODS_S)
        x, y = round(across * self._margin[0] / 2) * 2, round(down * self._margin[1])  # x is even: pixel pairs
        return self._scene[y : y + self.height, x : x + self.width].copy()


OBJECTS = 700
LIGHT, TEXTURE, LENS_BLUR_PX, SENSOR_NOISE = 0.12, 7.0, 0.55, 1.5
"""Variation of the lighting; sd of the finest texture and of noise in luma steps, for JPEGs of a natural size."""
LUMA_RANGE, CHROMA_RANGE = (16, 235), (16, 240)


def render_scene(width: int, height: int, seed: int) -> Pixels:
    """Return a scene as (height, width, 2) ``yuv422_yuy2``; ``width`` is even."""
    rng = np.random.default_rng(seed)
    yuv = _wall_and_floor(width, height)
    _paint_objects(yuv, rng)
    texture = _texture(width, height, rng)
    scene = np.empty((height, width, 2), np.uint8)
    scene[..., 0] = _luma(yuv, texture, rng)
    # U of the left and V of the right pixel of each pair; brighter spots of a surface are warmer: less blue, more red
    tint = _blur(texture, 2.0)[:, ::2]
    for column, share in ((0, -0.25), (1, 0.2)):
        chroma = cv2.GaussianBlur(yuv[:, :, column + 1], (0, 0), 1.2)[:, ::2] + share * TEXTURE * tint
        scene[:, column::2, 1] = chroma.clip(*CHROMA_RANGE)
    return scene


def _wall_and_floor(width: int, height: int) -> Pixels:
    """Paint the background as (height, width, 3) YUV: a light wall above a darker, warmer floor."""
    horizon = height * 2 // 5
    down = np.empty((height, 3))
    down[:horizon] = np.linspace((185, 124, 128), (150, 122, 131), horizon)
    down[horizon:] = np.linspace((85, 116, 138), (130, 112, 142), height - horizon)
    return np.repeat(down.astype(np.uint8)[:, None], width, axis=1)


def _paint_objects(yuv: Pixels, rng: np.random.Generator) -> None:
    """Paint ellipses and boxes, whose density falls with the cube of their size; later ones hide earlier ones."""
    height, width = yuv.shape[:2]
    largest, smallest = height / 5, max(1.5, height / 240)
    # inverse transform of p(r) ~ r^-3 between the two
    radii = (smallest**-2 - rng.random(OBJECTS) * (smallest**-2 - largest**-2)) ** -0.5
    # every picture has some objects near by, however the tail is drawn
    radii[:: OBJECTS // 12] = rng.uniform(0.4, 1.0, radii[:: OBJECTS // 12].size) * largest
    for radius in radii:
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        half = (max(1, round(radius)), max(1, round(radius * rng.uniform(0.4, 1.0))))
        colour = (rng.uniform(45, 200), *(128 + rng.normal(0, 11, 2)).clip(60, 200))
        tilt = float(rng.normal(0, 12))
        if rng.random() < 0.5:  # noqa: PLR2004
            cv2.ellipse(yuv, centre, half, tilt, 0, 360, colour, cv2.FILLED, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((centre, (2 * half[0], 2 * half[1]), tilt)).astype(np.int32)
            cv2.fillConvexPoly(yuv, corners, colour, cv2.LINE_AA)


def _texture(width: int, height: int, rng: np.random.Generator) -> Plane:
    """Return noise of every scale, with rough and smooth regions.

    Octaves of equal strength would be 1/f noise; coarse ones are weaker, because the objects have coarse power already.
    """
    texture = np.zeros((height, width), np.float32)
    cell = 2
    while cell <= height // 4:
        texture += (cell / 2) ** -0.3 * _noise(width, height, cell, rng)
        cell *= 2
    roughness = 0.6 * _noise(width, height, max(2, height // 4), rng)
    return cast("Plane", texture * np.exp(roughness))


def _luma(yuv: Pixels, texture: Plane, rng: np.random.Generator) -> Plane:
    height, width = texture.shape
    light = 1 + LIGHT * _noise(width, height, max(2, height // 2), rng)
    luma = _blur(yuv[..., 0] * light + TEXTURE * texture, LENS_BLUR_PX)
    luma += SENSOR_NOISE * rng.standard_normal((height, width), np.float32)
    return cast("Plane", luma.clip(*LUMA_RANGE))


def _noise(width: int, height: int, cell: int, rng: np.random.Generator) -> Plane:
    """Return smooth noise of unit scale whose bumps are ``cell`` pixels wide."""
    grid = rng.standard_normal((height // cell + 2, width // cell + 2), np.float32)
    return cast("Plane", cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC))


def _blur(plane: Plane, sigma_px: float) -> Plane:
    return cast("Plane", cv2.GaussianBlur(plane, (0, 0), sigma_px))
