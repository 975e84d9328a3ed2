"""Gaps between tokens: families of random gaps that profiles, the replay engine and the policy studies share.

A gap is the time from one token to the next, in seconds. Every family is scaled to its mean, so that jitter does not
change the rate. A family is a row of FAMILIES; `from_table` and `to_table` are its form in a profile.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from statistics import fmean
from typing import TYPE_CHECKING, Annotated, Any, Final, Protocol, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from s2a_bench.errors import UsageError
from s2a_bench.toml_file import wrong

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Floats: TypeAlias = "NDArray[np.float64]"
Mean = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Number = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Numbers = Annotated[tuple[float, ...], Field(strict=False)]
"""TOML has lists."""
STRICT: Final = ConfigDict(strict=True)


class Gaps(Protocol):
    @property
    def mean_s(self) -> float:
        """Return the mean gap, 1 / rate."""

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        """Draw gaps of shape (tokens, plans) in s; a column is one uninterrupted stretch, columns are independent."""


@dataclass(frozen=True, slots=True, config=STRICT)
class Constant:
    """No jitter; a mean of 0 is an answer at once."""

    mean_s: Number

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:  # noqa: ARG002 - nothing is random
        import numpy as np

        return np.full((tokens, plans), self.mean_s)


@dataclass(frozen=True, slots=True, config=STRICT)
class Lognormal:
    """Independent lognormal gaps; ``cv`` is standard deviation / mean."""

    mean_s: Mean
    cv: Number

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        return _lognormal(rng, self.mean_s, self.cv, (tokens, plans))


@dataclass(frozen=True, slots=True, config=STRICT)
class Markov:
    """Two states, normal and pause, each with lognormal gaps: a machine with interruptions.

    A token's gap keeps the state of the gap before it or draws a new one, so that a stretch starts stationary and the
    correlation of states falls geometrically.
    """

    mean_s: Mean
    cv: Number
    """The coefficient of variation within a state."""
    pause_share: Annotated[float, Field(ge=0, le=0.999)]
    """Share of the tokens whose gap is a pause."""
    pause_ratio: Number
    """Mean gap of a pause / mean normal gap."""
    pause_tokens: Number
    """Mean length of pauses in gaps; the least, 1 / (1 - pause_share), means independent gaps."""

    def __post_init__(self) -> None:
        if self.pause_tokens < (least := 1 / (1 - self.pause_share)):
            raise UsageError(f"pause_tokens: {self.pause_tokens:g} should be {least:g} or more")

    @property
    def normal_s(self) -> float:
        return self.mean_s / (1 + self.pause_share * (self.pause_ratio - 1))

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        import numpy as np

        shape = (tokens, plans)
        redraws = rng.random(shape, np.float32) < 1 / (self.pause_tokens * (1 - self.pause_share))
        paused = rng.random(shape, np.float32) < self.pause_share
        rows = np.arange(tokens, dtype=np.int32)[:, None]
        last = np.maximum.accumulate(np.where(redraws, rows, np.int32(0)), axis=0)  # the first row counts as drawn
        pauses = np.take_along_axis(paused, last, axis=0)
        gaps = _lognormal(rng, self.normal_s, self.cv, shape)
        gaps[pauses] *= self.pause_ratio
        return gaps


@dataclass(frozen=True, slots=True, config=STRICT)
class Bursty:
    """Tokens that arrive together, as through a network or proxy that batches: one long gap, then short ones.

    A stretch starts anywhere within a burst.
    """

    mean_s: Mean
    cv: Number
    """The coefficient of variation of the long gaps, and of the short ones."""
    burst_tokens: Annotated[int, Field(ge=1)]
    within: Annotated[float, Field(ge=0, le=1)]
    """Mean gap inside a burst / mean of all gaps."""

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        import numpy as np

        burst = self.burst_tokens
        scale = np.full(burst, self.within)
        scale[0] = burst - (burst - 1) * self.within
        places = np.arange(tokens)[:, None] + rng.integers(burst, size=plans)
        return np.asarray(_lognormal(rng, self.mean_s, self.cv, (tokens, plans)) * scale[places % burst])


@dataclass(frozen=True, slots=True, config=STRICT)
class Quantiles:
    """Independent gaps of any distribution, given as a piecewise linear quantile function."""

    mean_s: Mean
    levels: Numbers
    """Probabilities, from 0 to 1, increasing."""
    values: Numbers
    """The quantiles at ``levels``, in any unit: they are scaled so that the mean is ``mean_s``."""

    def __post_init__(self) -> None:
        if len(self.levels) < 2 or (self.levels[0], self.levels[-1]) != (0, 1):  # noqa: PLR2004 - a line has two ends
            raise UsageError("levels: should run from 0 to 1")
        if any(not low < high for low, high in zip(self.levels, self.levels[1:], strict=False)):
            raise UsageError("levels: should increase")
        if len(self.values) != len(self.levels):
            raise UsageError(f"values: {len(self.values)} of them for {len(self.levels)} levels")
        if any(not low <= high for low, high in zip(self.values, self.values[1:], strict=False)):
            raise UsageError("values: should not decrease")
        if not (self.values[0] >= 0 and 0 < self.values[-1] < math.inf):
            raise UsageError("values: should be finite, none negative, not all 0")

    def quantiles_s(self) -> Floats:
        import numpy as np

        values = np.asarray(self.values, dtype=np.float64)
        mean = float(np.diff(self.levels) @ (values[1:] + values[:-1])) / 2
        return values * (self.mean_s / mean)

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        import numpy as np

        return np.interp(rng.random((tokens, plans)), self.levels, self.quantiles_s())


@dataclass(frozen=True, slots=True, config=STRICT)
class Recorded:
    """A recording, played from a random place in each stretch; after its end it starts again."""

    mean_s: Mean
    trace: Numbers
    """Gaps in their order, in any unit: they are scaled so that their mean is ``mean_s``."""

    def __post_init__(self) -> None:
        if not self.trace or not all(0 <= gap < math.inf for gap in self.trace) or not any(self.trace):
            raise UsageError("trace: should hold finite gaps, none negative, not all 0")

    @staticmethod
    def of(trace_s: tuple[float, ...]) -> Recorded:
        return Recorded(fmean(trace_s), trace_s)

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> Floats:
        return self._at(rng.integers(len(self.trace), size=plans), tokens)

    def in_order(self, tokens: int, start: int = 0) -> Floats:
        """Return the gaps from number ``start`` on, of shape (tokens,), as recorded."""
        return self._at([start], tokens)[:, 0]

    def _at(self, starts: NDArray[np.int64] | list[int], tokens: int) -> Floats:
        import numpy as np

        gaps = np.asarray(self.trace, dtype=np.float64) * (self.mean_s / fmean(self.trace))
        return np.asarray(gaps[(np.arange(tokens)[:, None] + starts) % len(gaps)])


FAMILIES: dict[str, type[Constant | Lognormal | Markov | Bursty | Quantiles | Recorded]] = {
    "constant": Constant,
    "lognormal": Lognormal,
    "markov": Markov,
    "bursty": Bursty,
    "quantiles": Quantiles,
    "recorded": Recorded,
}
"""A family's name in a profile -> the class; its fields are the keys beside ``family``."""


def from_table(table: Mapping[str, Any], mean_s: float, where: str = "") -> Gaps:
    """Make gaps from a TOML table: ``family`` and all of that family's parameters except the mean.

    Raises UsageError, naming the key after ``where``, for an unknown family or key and a wrong value.
    """
    name = table.get("family")
    if not isinstance(name, str) or name not in FAMILIES:
        raise UsageError(f"{where}family: {name!r} is not one of {', '.join(FAMILIES)}")
    family = FAMILIES[name]
    keys = [field.name for field in fields(family) if field.name != "mean_s"]
    values = {key: value for key, value in table.items() if key != "family"}
    if unknown := [key for key in values if key not in keys]:
        raise UsageError(f"{where}{unknown[0]}: {name} gaps have no such key; they have {', '.join(keys) or 'none'}")
    try:
        return family(mean_s=mean_s, **values)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{where}{first['loc'][0]}: {wrong(first)}") from error
    except UsageError as error:
        raise UsageError(f"{where}{error}") from error


def read_family(written: str, field: str) -> dict[str, str | int | float]:
    """Read ``FAMILY:key=number,...`` as a table; raises UsageError naming the ``field``."""
    family, _, rest = written.partition(":")
    table: dict[str, str | int | float] = {"family": family}
    for pair in filter(None, rest.split(",")):
        key, _, value = pair.partition("=")
        try:
            number = float(value)
        except ValueError:
            form = f"'{pair}' should be key=number, as in lognormal:cv=0.5"
            raise UsageError(f"`{field}`: {written}: {form}") from None
        table[key.strip()] = int(number) if number.is_integer() else number
    return table


def to_table(gaps: Gaps) -> dict[str, Any]:
    """Return the table that `from_table` reads, which has no mean."""
    name = next(name for name, family in FAMILIES.items() if family is type(gaps))
    values: dict[str, Any] = TypeAdapter(type(gaps)).dump_python(gaps, mode="json", exclude={"mean_s"})
    return {"family": name} | values


def _lognormal(rng: np.random.Generator, mean_s: float, cv: float, shape: tuple[int, int]) -> Floats:
    import numpy as np

    variance = np.log1p(cv**2)
    gaps = rng.standard_normal(shape)  # then in place: the values of rng.lognormal, a third faster
    gaps *= np.sqrt(variance)
    gaps += np.log(mean_s) - variance / 2
    return np.exp(gaps, out=gaps)
