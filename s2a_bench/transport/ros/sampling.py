"""What a goal wants of sampling: the fields of ``llama_msgs/SamplingConfig`` that differ from their defaults.

A client that does not care sends the defaults, and then the engine's own settings hold.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any, Final

import numpy as np

from s2a_bench.errors import RequestFailed
from s2a_bench.ros.llama import sampling_config
from s2a_bench.types import Sampling

BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "temp": (0, 100),
    "top_k": (-1, 2**31 - 1),
    "top_p": (0, 1),
    "min_p": (0, 1),
    "typical_p": (0, 1),
    "penalty_last_n": (-1, 2**20),
    "penalty_repeat": (0.01, 100),
    "penalty_freq": (-100, 100),
    "penalty_present": (-100, 100),
    "mirostat": (0, 2),
    "mirostat_eta": (0, 10),
    "mirostat_tau": (0.01, 100),
}
"""Field -> what makes sense of it: the numbers that an engine may honour."""
ELSEWHERE: Final = frozenset({"seed", "grammar", "dry_sequence_breakers"})
"""What the goal says besides, and what ROS itself encodes in two ways."""

_log = logging.getLogger(__name__)


class Wishes:
    """Reads what goals want, and logs once what the engine does not honour."""

    def __init__(self, honoured: Collection[str], version: str) -> None:
        """Know the fields that the engine honours, and a version's defaults."""
        self._honoured = honoured
        self._defaults = sampling_config(version)
        self._said: set[str] = set()

    def of(self, config: Any) -> Sampling:
        """Return the wishes that the engine honours; raises RequestFailed for a number that makes no sense."""
        defaults = vars(self._defaults).items()
        wanted = [name for name, default in defaults if _differs(getattr(config, name, default), default)]
        left_out = [name for name in wanted if name not in self._honoured and name not in self._said | ELSEWHERE]
        if left_out:
            self._said.update(left_out)
            _log.warning("not honoured of goals' sampling_config: %s", ", ".join(left_out))
        return tuple((name, _checked(name, getattr(config, name))) for name in wanted if name in self._honoured)


def _differs(value: Any, default: Any) -> bool:
    if isinstance(default, float):
        return bool(np.float32(value) != np.float32(default))
    return not np.array_equal(value, default) if isinstance(default, np.ndarray) else bool(value != default)


def _checked(name: str, value: float) -> float:
    least, most = BOUNDS[name]
    if not least <= value <= most:
        raise RequestFailed(f"sampling_config.{name}: {value:g} is not {least:g} to {most:g}")
    return value
