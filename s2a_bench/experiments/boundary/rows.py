"""The rows of a boundary run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from s2a_bench.experiments.cells import JsonKey
from s2a_bench.store.schema import Fraction, Many, Positive, Table, about

Duration: TypeAlias = Literal["t_nom", "t_min"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BoundaryRow:
    """One point of the plane of tokens per skill and rate: whether naive is stall-free there, by formula and by trial.

    ``duration`` of every skill: t_nom or t_min.
    """

    duration: Duration
    duration_s: Positive
    tokens_per_skill: Annotated[Many, about("L, the delimiter included.")]
    tokens_per_s: Annotated[Positive, JsonKey("rate_tokens_per_s")]
    board: Annotated[str, JsonKey("profile"), about("The board that has this rate; null for a point of the grid.")]
    n_skills: Many
    family: Annotated[str, about("--jitter.")]
    plans: Many
    stall_free: Annotated[bool, about("What the formula says of even tokens.")]
    p_stall: Annotated[Fraction, about("Share of the plans that stalled when tried.")]

    @property
    def cell(self) -> str:
        """The cell of its provenance: a board, or the grid."""
        return self.board


@dataclass(frozen=True, slots=True, kw_only=True)
class BoundaryCell(BoundaryRow):
    """A point of the grid, or a board on it, in ``--json``."""

    rho: Annotated[Positive, about("L / R over the duration: stall-free up to 1.")]
    emulated: Literal[True]


BOUNDARY: Final[Table[BoundaryRow]] = Table("boundary", BoundaryRow)
