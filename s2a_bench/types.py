"""The types that all rooms share: a frame, a request about frames, a piece of the answer: a token or an action."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Pixels: TypeAlias = "NDArray[np.uint8]"
Vector: TypeAlias = "NDArray[np.float32]"

Bayer: TypeAlias = Literal["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"]
Yuv: TypeAlias = Literal["yuv422_yuy2", "yuv422", "nv12", "nv21"]
Deep: TypeAlias = Literal["mono16", "rgb16", "bgr16"]
Encoding: TypeAlias = Literal["bgr8", "rgb8", "bgra8", "rgba8", "mono8", Deep, Yuv, Bayer, "jpeg", "png"]
"""Pixel formats by their ROS names (``sensor_msgs/image_encodings.hpp``), and the two compressed ones."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture in the format of its source.

    ``data`` is uint8: (height, width, 2) for ``yuv422_yuy2``, ``yuv422`` (UYVY) and ``mono16`` (in this machine's order
    of bytes), (height, width, 6) for ``rgb16`` and ``bgr16``, (height, width, 3) for ``bgr8`` and ``rgb8``,
    (height, width, 4) for ``bgra8`` and ``rgba8``,
    (height, width) for ``mono8`` and mosaics, (height * 3 / 2, width) for ``nv12`` and ``nv21``, (n,) for ``jpeg`` and
    ``png``. ``stamp_ns`` is the time of capture on CLOCK_MONOTONIC; ``index`` counts frames of one source from 0.
    """

    index: int
    stamp_ns: int
    width: int
    height: int
    encoding: Encoding
    data: Pixels

    @property
    def pixel_count(self) -> int:
        return self.width * self.height


Sampling: TypeAlias = "tuple[tuple[str, float], ...]"
"""A client's sampling settings: llama.cpp's names, and their values; an engine ignores those it does not support."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Duration of one skill in seconds, and its limits: 0 < least <= nominal <= most (T_min, T_nom, T_max)."""

    nominal_s: float
    least_s: float
    most_s: float


@dataclass(frozen=True, slots=True)
class Request:
    """One request to a model: a prompt about zero or more pictures and the robot's state.

    A client receives it with frames as captured; a handler and an engine receive it with ``rgb8`` frames.
    ``max_tokens`` limits the pieces of the answer, tokens or actions. ``grammar`` is GBNF text (llama.cpp
    ``grammars/README.md``); an empty string means none. ``state`` is the robot's (joint angles, gripper) in its units,
    each a float32; empty: none.
    """

    id: str
    prompt: str
    images: tuple[Frame, ...] = ()
    max_tokens: int = 32
    grammar: str = ""
    seed: int = 0
    sampling: Sampling = ()
    state: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Token:
    """One piece of the answer as it leaves the model; ``id`` is the vocabulary index, -1 if unknown."""

    index: int
    text: str
    id: int = -1


@dataclass(frozen=True, slots=True, eq=False)
class Action:
    """One piece of a policy's answer: the robot's action in one control tick, part of a chunk.

    ``index`` counts ticks of the chunk from 0; ``values`` is float32 (D,), in the robot's units.
    """

    index: int
    values: Vector
    id: ClassVar[int] = -1

    @property
    def text(self) -> str:
        """Return the values as a JSON list, each in the shortest text of the same float32."""
        return json.dumps([float(str(value)) for value in self.values])


Piece: TypeAlias = Token | Action
"""A piece of an answer; all pieces of one answer are of one kind."""
