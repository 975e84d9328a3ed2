"""The options of a boundary run."""

from __future__ import annotations

from typing import Annotated, ClassVar, Final

from pydantic import Field

from s2a_bench.boards.tokens import NO_JITTER, gaps_of
from s2a_bench.errors import UsageError
from s2a_bench.options import SEVERAL, Names, Numbers, Options, option

PLANS: Final = 2000
"""Plans a point with jitter; without jitter all plans are equal."""
MARKS, SHADES = 25, 73
"""Rates of a grid that is drawn as marks, or as shades."""

Length = Annotated[int, Field(ge=1, le=1000)]


class BoundaryConfig(Options):
    """The plane of tokens per skill and rate."""

    virtual: ClassVar[bool] = True

    profiles: Names = option(
        ("rtx-4080", "jetson-agx-orin", "jetson-orin-nano"),
        "boards to mark: names of 'profile list', or paths; several with commas",
        flag="profile",
    )
    tokens_per_skill: Annotated[tuple[Length, ...], SEVERAL] = option((6, 4, 2, 1), "L at which boards are marked")
    most_tokens: int = option(8, "the plane has L = 1 to this", ge=1, le=1000)
    rates: Numbers = option((0.3, 60.0), "tokens/s of the plane: from, to")
    points: int | None = option(
        None,
        f"rates tried between them, on a logarithmic scale [default: {MARKS}; with jitter {SHADES}]",
        ge=2,
        le=1000,
    )
    n_skills: int = option(8, "N, skills a plan", ge=2, le=10_000)
    t_nom_s: float = option(1.0, "seconds a skill takes", flag="t-nom", gt=0, allow_inf_nan=False)
    t_min: float = option(0.8, "least duration of a skill, as a factor of T_nom", gt=0, le=1)
    jitter: str = option(
        NO_JITTER, "none (tokens come evenly), or a family of gaps, as lognormal:cv=0.2: P(stall) is shaded"
    )
    plans: int | None = option(None, f"plans a point [default: 1; with jitter {PLANS}]", ge=1, le=1_000_000)
    seed: int = option(0, "seed of everything that is drawn", ge=0)

    @property
    def rates_tried(self) -> int:
        return self.points or (MARKS if self.jitter == NO_JITTER else SHADES)

    @property
    def plans_a_point(self) -> int:
        return self.plans or (1 if self.jitter == NO_JITTER else PLANS)

    def check(self) -> None:
        if len(self.rates) != 2 or not 0 < self.rates[0] < self.rates[1] < float("inf"):  # noqa: PLR2004 - from, to
            raise UsageError("`rates`: should be two tokens/s, the lower first, as 0.3,60")
        if self.jitter == NO_JITTER and self.plans_a_point > 1:
            raise UsageError("`plans`: without `jitter` all plans are the same; leave it out")
        gaps_of(self.jitter, 1.0)

    def to_manifest(self) -> dict[str, object]:
        return {**self.model_dump(), "plans": self.plans_a_point, "points": self.rates_tried}
