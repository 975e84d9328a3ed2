"""Gaps between tokens: families of random gaps that profiles, the replay engine and the policy studies share.

A gap is the time from one token to the next, in seconds. Every family is scaled to its mean, so that a rate stays a
rate whatever the jitter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]


class Gaps(Protocol):
    """A family with its parameters."""

    @property
    def mean_s(self) -> float:
        """Return the mean gap, 1 / rate."""
        ...

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        """Draw gaps of shape (tokens, plans) in s; a column is one uninterrupted stretch, columns are independent."""
        ...


@dataclass(frozen=True, slots=True)
class Constant:
    """No jitter."""

    mean_s: float

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:  # noqa: ARG002 - nothing is random
        """Return the same gap everywhere."""
        import numpy as np

        return np.full((tokens, plans), self.mean_s)


@dataclass(frozen=True, slots=True)
class Lognormal:
    """Independent lognormal gaps; ``cv`` is standard deviation / mean."""

    mean_s: float
    cv: float

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        """Draw gaps."""
        import numpy as np

        variance = np.log1p(self.cv**2)
        return rng.lognormal(np.log(self.mean_s) - variance / 2, np.sqrt(variance), (tokens, plans))
