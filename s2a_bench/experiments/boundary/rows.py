"""The rows of a boundary run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from s2a_bench.store.schema import Fraction, Many, Positive, Table, about


@dataclass(frozen=True, slots=True)
class BoundaryRow:
    """One point of the plane of tokens per skill and rate: whether naive is stall-free there, by formula and by trial.

    ``duration`` of every skill: t_nom or t_min. ``board`` is the profile with this rate, empty for points of the grid.
    """

    duration: str
    duration_s: Positive
    tokens_per_skill: Annotated[Many, about("L, the delimiter included.")]
    tokens_per_s: float
    board: str
    n_skills: Many
    family: Annotated[str, about("--jitter.")]
    plans: Many
    stall_free: Annotated[bool, about("What the formula says of even tokens.")]
    p_stall: Annotated[Fraction, about("Share of the plans that stalled when tried.")]

    @property
    def cell(self) -> str:
        """The cell of its provenance: a board, or the grid."""
        return self.board


BOUNDARY: Final[Table[BoundaryRow]] = Table("boundary", BoundaryRow)
