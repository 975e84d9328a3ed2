"""Where latencies come from: a number, a family of random ones, a CSV file, a run folder, a profile.

A family is one of `boards.gaps.FAMILIES`, written ``FAMILY:mean_ms=80,key=value,...``; ``bimodal`` is `markov` whose
pauses come alone. Successive values of a family that remembers (markov, bursty, recorded) follow one another.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.boards.gaps import FAMILIES, Constant, Gaps, from_table
from s2a_bench.errors import UsageError
from s2a_bench.provenance import NONE, Provenance

if TYPE_CHECKING:
    import numpy as np

    from s2a_bench.policy.chunks import Ints

EXAMPLE: Final = "lognormal:mean_ms=80,cv=0.5"
LONGEST_MS: Final = 3_600_000.0
_PARAMETER: Final = re.compile(r"\s*\w+\s*=")
_KINDS: Final = "should be a number of ms, a family, a .csv file, a run folder, or a profile of 'profile list'"


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Latencies under a name: drawn from ``gaps`` or by ``tokens``, or ``recorded_ns``, whichever it has."""

    name: str
    gaps: Gaps | None = None
    recorded_ns: Ints | None = None
    profile: str = ""
    """The board whose tokens make a chunk."""
    tokens: int = 0
    """Tokens of a chunk, where a profile answers."""
    weights: str = NONE
    requests: tuple[Mapping[str, object], ...] = ()
    """Of measured ones what is known of each request, by the columns of `delays.COLUMNS`."""

    @property
    def provenance(self) -> Provenance:
        """Return where numbers come from that are computed with these latencies."""
        return Provenance.computed(self.name, self.weights)

    def draw(self, rng: np.random.Generator, count: int) -> Ints:
        """Draw latencies of shape (count,), in ns; raises TypeError for recorded ones, which are not drawn."""
        import numpy as np

        if self.profile:
            from s2a_bench.boards.search import load_profile
            from s2a_bench.experiments.timeline.plans import AS_PROFILE, board_of_profile

            board = board_of_profile(load_profile(self.profile), AS_PROFILE, None)
            latency_s = board.tokens(self.tokens, rng, count)[-1]
        elif self.gaps is not None:
            latency_s = self.gaps.sample(rng, count, 1)[:, 0]
        else:
            raise TypeError(f"{self.name} is a recording")
        latency_ns: Ints = np.rint(latency_s * 1e9).astype(np.int64)
        return latency_ns


def sources(written: str, tokens: int) -> Iterator[Source]:
    """Read one source as people write it; raises S2AError naming the field.

    A run folder has a source a cell, FOLDER#CELL one alone. ``tokens`` are those of a chunk, where a profile answers.
    """
    if (constant := _number(written)) is not None:
        if not 0 <= constant <= LONGEST_MS:
            raise UsageError(f"`latency`: {written} should be between 0 and {LONGEST_MS:g} ms")
        yield Source(written, Constant(constant / 1e3) if constant else _Nothing())
    elif ":" in written and "/" not in written:
        yield Source(written, family(written))
    elif written.endswith(".csv"):
        from s2a_bench.experiments.chunks.delays import read_delays

        yield Source(written, recorded_ns=read_delays(Path(written)))
    elif Path(folder := written.partition("#")[0]).is_dir():
        from s2a_bench.experiments.chunks.measured import measured

        yield from measured(Path(folder), written.partition("#")[2])
    else:
        yield _of_profile(written, tokens)


def family(written: str) -> Gaps:
    """Read ``FAMILY:mean_ms=80,key=value,...``; raises UsageError naming the field."""
    name, _, rest = written.partition(":")
    table: dict[str, str | int | float] = {"family": "markov" if name == "bimodal" else name}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        number = _number(value)
        if not equals or number is None:
            raise UsageError(f"`latency`: {written}: '{part}' should be key=number, as in {EXAMPLE}")
        table[key.strip()] = int(number) if key == "burst_tokens" and number.is_integer() else number
    mean_ms = table.pop("mean_ms", None)
    if name not in {*FAMILIES, "bimodal"}:
        raise UsageError(f"`latency`: '{name}' is none of the families {', '.join(FAMILIES)}, bimodal")
    if not isinstance(mean_ms, float) or not 0 < mean_ms <= LONGEST_MS:
        raise UsageError(f"`latency`: {written}: mean_ms should be above 0 and at most {LONGEST_MS:g}, as in {EXAMPLE}")
    if name == "bimodal" and isinstance(share := table.get("pause_share"), float) and 0 <= share < 1:
        table["pause_tokens"] = 1 / (1 - share)
    try:
        return from_table(table, mean_ms / 1e3)
    except UsageError as error:
        raise UsageError(f"`latency`: {written}: {error}") from error


def split(value: object) -> object:
    """Split text at the commas between sources, not at those within a family's parameters, and keep each once."""
    if not isinstance(value, str):
        return tuple(map(str, value)) if isinstance(value, (list, tuple)) else (str(value),)
    found: list[str] = []
    for part in (part.strip() for part in value.split(",") if part.strip()):
        goes_on = found and ":" in found[-1] and _PARAMETER.match(part)
        found[-1:] = [f"{found[-1]},{part}"] if goes_on else [*found[-1:], part]
    return tuple(dict.fromkeys(found))


class _Nothing:
    """Answers at once: a constant family has to have a mean above 0."""

    mean_s = 0.0

    def sample(self, rng: np.random.Generator, tokens: int, plans: int) -> np.ndarray:  # noqa: ARG002
        """Return zeros."""
        import numpy as np

        return np.zeros((tokens, plans))


def _of_profile(written: str, tokens: int) -> Source:
    from s2a_bench.boards.search import load_profile, profile_files

    if written not in profile_files() and not (written.endswith(".toml") and Path(written).is_file()):
        raise UsageError(f"`latency`: '{written}' {_KINDS}")
    return Source(written, profile=written, tokens=tokens, weights=load_profile(written).weights)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
