"""A policy of chunks that knows the world: Meta-World's scripted expert, rolled out in a copy of the simulator."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
from metaworld.policies import ENV_POLICY_MAP

from s2a_bench.types import Pixels, Vector
from studies.task import HORIZON
from studies.task.world import Copy

warnings.filterwarnings("ignore", "Constant", module="metaworld")  # of every expert that asks for more than 1


@cache
def _copy(task: str) -> Copy:
    return Copy(task)


def chunk(pictures: tuple[Pixels, ...], state: Vector, prompt: str) -> Vector:  # noqa: ARG001 - it knows the state
    """Return the expert's next `HORIZON` actions from an observation of `World`, float32 (H, 4); prompt: the task."""
    expert, copy = ENV_POLICY_MAP[prompt](), _copy(prompt)
    seen = copy.restore(state)
    actions = np.empty((HORIZON, 4), np.float32)
    for action in actions:
        action[:] = np.clip(expert.get_action(seen), -1, 1)
        seen = copy.step(action)
    return actions
