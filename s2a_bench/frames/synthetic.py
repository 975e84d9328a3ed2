"""A camera without a camera: deterministic YUYV frames with the statistics of natural pictures.

The scene is rendered when the camera is made, larger than a frame; a frame is a window of it that moves along
a Lissajous curve. So capture costs one copy, as from a driver's buffer, and what is measured is the transport.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from s2a_bench.clock import now_ns
from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import check_size
from s2a_bench.frames.scene import render_scene
from s2a_bench.types import Encoding, Frame

if TYPE_CHECKING:
    from s2a_bench.types import Pixels

PERIODS_S = (11.0, 7.0)
"""How long the window takes there and back, across and down; coprime, so the path closes after 77 s only."""


class SyntheticCamera:
    """A window moving over a rendered scene: (h, w, 2) ``yuv422_yuy2``.

    The same size, ``fps`` and ``seed`` give the same frames. ``fps`` sets how far the window moves between two
    frames; read() never waits. The noise moves with the scene, where a sensor's would be new in every frame.
    Raises UsageError for an odd or tiny size.
    """

    where: ClassVar[str] = ""
    encoding: Encoding = "yuv422_yuy2"

    def __init__(self, where: str, width: int, height: int, *, fps: float = 30.0, seed: int = 0) -> None:
        """Render the scene; ``where`` is empty, since there is nothing to open."""
        check_size(width, height, smallest=16, even=True)
        if not fps > 0:
            raise UsageError(f"`fps`: {fps} should be above 0")
        self.name = f"synthetic:{where}" if where else "synthetic"
        self.width, self.height, self.fps = width, height, fps
        # a quarter of the frame each way is room enough to move, and soon rendered
        self._room = (width // 8 * 2, height // 4)
        self._scene: Pixels | None = render_scene(width + self._room[0], height + self._room[1], seed)
        self._index = 0

    def read(self) -> Frame:
        """Copy the next window out of the scene; SourceError once closed."""
        stamp_ns = now_ns()
        if self._scene is None:
            raise SourceError("`source`: the synthetic camera was closed, it has no more frames")
        index = self._index
        x, y = self._corner(index / self.fps)
        data = self._scene[y : y + self.height, x : x + self.width].copy()
        self._index += 1
        return Frame(index, stamp_ns, self.width, self.height, self.encoding, data)

    def close(self) -> None:
        """Let go of the scene."""
        self._scene = None

    def _corner(self, t_s: float) -> tuple[int, int]:
        """Return where the window's upper left corner is; x is even, so that pixel pairs stay whole."""
        across, down = (0.5 + 0.5 * math.sin(math.tau * t_s / period_s) for period_s in PERIODS_S)
        return round(across * self._room[0] / 2) * 2, round(down * self._room[1])
