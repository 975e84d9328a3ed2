"""The actions of engines that have no policy: smooth motion of every joint, the same for the same seed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import tau

import numpy as np
from numpy.typing import NDArray

from s2a_bench.inference import EngineConfig
from s2a_bench.types import Action, Request

PERIOD = 50
"""Control ticks of one swing: a second at 50 Hz."""


@lru_cache(8)
def swing(horizon: int, dims: int, seed: int) -> NDArray[np.float32]:
    """Return sines of amplitude 1, each joint and each seed in a phase of its own: float32 (horizon, dims)."""
    ticks, joints = np.arange(horizon)[:, None], np.arange(dims)[None, :]
    values = np.sin(tau * (ticks + seed) / PERIOD + joints).astype(np.float32)
    values.flags.writeable = False
    return values


def chunk(config: EngineConfig, request: Request) -> Iterator[Action]:
    """Yield as many actions as an engine is told, and as a request takes."""
    values = swing(config.horizon, config.action_dim, request.seed)
    for index in range(max(0, min(config.horizon, request.max_tokens))):
        yield Action(index, values[index])
