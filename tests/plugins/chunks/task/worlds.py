"""Policies and a world of pictures, for processes that import them."""

from __future__ import annotations

from typing import Any, Final
from zlib import crc32

import gymnasium
import numpy as np
from numpy.typing import NDArray

HERE: Final = "tests.plugins.chunks.task.worlds"
LETTERS: Final = 2**20


def balance(_pictures: object, state: NDArray[np.float32], prompt: str) -> NDArray[np.float64]:
    """Push CartPole to where its pole falls, in a chunk as long as the prompt says."""
    return np.full((int(prompt), 1), float(state[2] + 0.3 * state[3] > 0))


def swing(_pictures: object, state: NDArray[np.float32], prompt: str) -> NDArray[np.float64]:
    """Push by the last number of the state."""
    return np.full((int(prompt), 1), state[-1])


def broken(*_: object) -> None:
    raise KeyError("gripper")


def looks(pictures: tuple[NDArray[np.uint8], ...], state: NDArray[np.float32], _prompt: str) -> list[float]:
    """Return what tells the picture from every other, next to the state."""
    (picture,) = pictures
    return [print_of(picture), *state]


def print_of(picture: NDArray[np.uint8]) -> int:
    """Return a number from 1 that float32 holds."""
    return 1 + crc32(repr(picture.shape).encode() + picture.tobytes()) % LETTERS


class Pictures(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """Pays 1 for the action that `looks` gives to one of its pictures, with the state beside it; refuses others."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - as gymnasium's
    action_space = gymnasium.spaces.Box(-LETTERS - 1, LETTERS + 1, (2,), np.float64)
    observation_space = gymnasium.spaces.Box(0, np.inf, (1,), np.float64)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._next(0)
        self._drawn = {(0.0, 0.0)}
        return np.array([self._tick]), {}

    def _next(self, tick: int) -> None:
        self._tick = tick
        self._picture = self.np_random.integers(0, 256, (24, 40, 3), np.uint8)

    def render(self) -> NDArray[np.uint8]:
        self._drawn.add((print_of(self._picture), self._tick))
        return self._picture

    def step(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        if tuple(action) not in self._drawn:
            raise ValueError(f"{action} is of none of its pictures")
        self._next(self._tick + 1)
        return np.array([self._tick]), float(action[0] > 0), False, False, {}


gymnasium.register("Pictures-v0", f"{HERE}:Pictures")
