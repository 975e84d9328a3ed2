"""Meta-World's scripted experts as a policy: the prompt is the name of the task, the state the whole observation."""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any

from s2a_bench import extras
from s2a_bench.types import Pixels, Vector


@cache
def _experts() -> Any:
    return extras.require("metaworld.policies", "gym").ENV_POLICY_MAP


def expert(pictures: tuple[Pixels, ...], state: Vector, prompt: str) -> Any:  # noqa: ARG001 - it knows the state
    """Return one action, float32 (4,)."""
    if prompt not in _experts():
        raise ValueError(f"prompt '{prompt}' is not a task of Meta-World, as push-v3")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # most experts ask for more than 1, which is clipped
        return _experts()[prompt]().get_action(state)
