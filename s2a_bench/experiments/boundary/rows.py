"""The rows of a boundary run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class BoundaryRow:
    """One point of the plane of tokens per skill and rate: whether naive is stall-free there, by formula and by trial.

    ``duration`` names what every skill takes: t_nom or t_min. ``board`` is the profile that has this rate, empty for
    points of the grid. ``stall_free`` is the formula's answer, ``p_stall`` the share of ``plans`` that stalled.
    """

    duration: str
    duration_s: float
    tokens_per_skill: int
    tokens_per_s: float
    board: str
    n_skills: int
    family: str
    plans: int
    stall_free: bool
    p_stall: float


BOUNDARY: Final[Table[BoundaryRow]] = Table("boundary", BoundaryRow)
"""One row a point of the plane."""
