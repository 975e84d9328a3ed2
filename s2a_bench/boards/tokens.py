"""Boards that stream tokens, evenly or with jitter, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.boards.gaps import Constant, Floats, Gaps, Lognormal, Recorded, from_table, read_family
from s2a_bench.boards.profile import Profile
from s2a_bench.errors import UsageError
from s2a_bench.options import option
from s2a_bench.provenance import Provenance

if TYPE_CHECKING:
    import numpy as np

NO_JITTER: Final = "none"
AS_PROFILE: Final = "profile"
PROMPT_TIME: Final[Any] = option(
    None,
    "seconds before decoding, c [default: the profile's; with --rate 0]",
    flag="prompt-time",
    ge=0,
    allow_inf_nan=False,
)
"""The option of whatever names a board by its rate."""


@dataclass(frozen=True, slots=True)
class Board:
    name: str
    """The profile's; empty for a rate."""
    title: str
    origin: str
    """The rate's: paper, measured or given."""
    tokens_per_s: float
    prompt_s: float
    """c: tokens arrive evenly from then on, so that the time to first token is c + 1 / R."""
    prompt_origin: str
    """c's: assumed, measured or given."""
    gaps: Gaps
    prompt_cv: float = 0.0
    rate_cv: float = 0.0
    profile_origin: Provenance = field(default_factory=Provenance.computed)
    """The profile's, with its model's weights; none for a bare rate."""

    @property
    def provenance(self) -> Provenance:
        return replace(self.profile_origin, profile=self.name or self.title)

    @property
    def even(self) -> bool:
        """Whether every plan's tokens arrive at the same times."""
        return isinstance(self.gaps, Constant) and self.prompt_cv == self.rate_cv == 0

    def tokens(self, count: int, rng: np.random.Generator, plans: int) -> Floats:
        """Draw when each token arrives, shape (count, plans), in s from the request: prompt time, rate, then gaps."""
        token_s = self.gaps.sample(rng, count, plans)
        token_s *= _factors(self.rate_cv, rng, plans)
        token_s[0] += self.prompt_s * _factors(self.prompt_cv, rng, plans)
        token_s.cumsum(axis=0, out=token_s)
        return token_s


def board_of_profile(profile: Profile, jitter: str, prompt_s: float | None) -> Board:
    """Make a board of a profile; ``prompt_s`` replaces its c, and ``--jitter profile`` adds its spreads."""
    assumed = "assumed" if "prompt_s" in profile.assumed else "measured"
    own, mean_s = jitter == AS_PROFILE, 1 / profile.tokens_per_s
    gaps = profile.gaps if own else gaps_of(jitter, mean_s)
    if own and profile.trace_s:
        gaps = Recorded(mean_s, profile.trace_s)
    recorded = isinstance(gaps, Recorded)  # it holds each answer's own rate already
    return Board(
        name=profile.name,
        title=profile.title,
        origin=profile.origin,
        tokens_per_s=profile.tokens_per_s,
        prompt_s=profile.prompt_s if prompt_s is None else prompt_s,
        prompt_origin=assumed if prompt_s is None else "given",
        gaps=gaps,
        prompt_cv=profile.prompt_cv if own else 0.0,
        rate_cv=profile.rate_cv if own and not recorded else 0.0,
        profile_origin=profile.provenance,
    )


def board_of_rate(tokens_per_s: float, jitter: str, prompt_s: float | None) -> Board:
    """Make a board of a bare rate; raises UsageError for the jitter of a profile."""
    if jitter == AS_PROFILE:
        raise UsageError(f"`jitter`: {AS_PROFILE} needs `profiles`; `rates` alone takes a family, as lognormal:cv=0.2")
    return Board(
        name="",
        title=f"{tokens_per_s:g} tokens/s",
        origin="given",
        tokens_per_s=tokens_per_s,
        prompt_s=prompt_s or 0.0,
        prompt_origin="given" if prompt_s is not None else "assumed",
        gaps=gaps_of(jitter, 1 / tokens_per_s),
    )


def gaps_of(jitter: str, mean_s: float) -> Gaps:
    """Read ``none`` or ``FAMILY:key=value,...`` of `jitter.FAMILIES`; raises UsageError naming the field."""
    table = read_family("constant" if jitter == NO_JITTER else jitter, "jitter")
    return from_table(table, mean_s, f"`jitter` {jitter}: ")


def _factors(cv: float, rng: np.random.Generator, plans: int) -> Floats | float:
    return Lognormal(1.0, cv).sample(rng, 1, plans)[0] if cv else 1.0
