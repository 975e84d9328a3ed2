"""A point of a boundary run as ``--json`` and its schema hold it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal


@dataclass(frozen=True, slots=True)
class BoundaryCell:
    """A point of the grid, or a board on it."""

    duration: Literal["t_nom", "t_min"]
    duration_s: Annotated[float, {"exclusiveMinimum": 0}]
    tokens_per_skill: Annotated[int, {"description": "L, the delimiter included.", "minimum": 1}]
    rate_tokens_per_s: Annotated[float, {"exclusiveMinimum": 0}]
    profile: Annotated[str | None, {"description": "The board that has this rate; null for a point of the grid."}]
    emulated: Literal[True]
    n_skills: Annotated[int, {"minimum": 1}]
    family: Annotated[str, {"description": "--jitter."}]
    plans: Annotated[int, {"minimum": 1}]
    rho: Annotated[float, {"description": "L / R over the duration: stall-free up to 1.", "exclusiveMinimum": 0}]
    stall_free: Annotated[bool, {"description": "What the formula says of even tokens."}]
    p_stall: Annotated[
        float, {"description": "Share of the plans that stalled when tried.", "minimum": 0, "maximum": 1}
    ]
