"""Where latencies come from: what `boards.latency` reads, a run folder, a profile."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from s2a_bench.boards.gaps import Gaps
from s2a_bench.boards.latency import draw_ns, read_latency, whole_ns
from s2a_bench.errors import UsageError
from s2a_bench.provenance import NONE, Provenance

if TYPE_CHECKING:
    import numpy as np

    from s2a_bench.policy.chunks import Ints

_PARAMETER: Final = re.compile(r"\s*\w+\s*=")


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
        if self.profile:
            from s2a_bench.boards.search import load_profile
            from s2a_bench.experiments.timeline.plans import AS_PROFILE, board_of_profile

            board = board_of_profile(load_profile(self.profile), AS_PROFILE, None)
            return whole_ns(board.tokens(self.tokens, rng, count)[-1])
        if self.gaps is None:
            raise TypeError(f"{self.name} is a recording")
        return draw_ns(self.gaps, rng, count)


def sources(written: str, tokens: int) -> Iterator[Source]:
    """Read one source as people write it; raises S2AError naming the field.

    A run folder has a source a cell, FOLDER#CELL one alone. ``tokens`` are those of a chunk, where a profile answers.
    """
    if (read := read_latency(written)) is not None:
        yield Source(written, read.gaps, read.recorded_ns)
    elif Path(folder := written.partition("#")[0]).is_dir():
        from s2a_bench.experiments.chunks.measured import measured

        yield from measured(Path(folder), written.partition("#")[2])
    else:
        yield _of_profile(written, tokens)


def split(value: object) -> object:
    """Split text at the commas between sources, not at those within a family's parameters, and keep each once."""
    if not isinstance(value, str):
        return tuple(map(str, value)) if isinstance(value, (list, tuple)) else (str(value),)
    found: list[str] = []
    for part in (part.strip() for part in value.split(",") if part.strip()):
        goes_on = found and ":" in found[-1] and _PARAMETER.match(part)
        found[-1:] = [f"{found[-1]},{part}"] if goes_on else [*found[-1:], part]
    return tuple(dict.fromkeys(found))


def _of_profile(written: str, tokens: int) -> Source:
    from s2a_bench.boards.search import load_profile, profile_files

    if written not in profile_files() and not (written.endswith(".toml") and Path(written).is_file()):
        kinds = "a number of ms, a family, a .csv file, a run folder, or a profile of 'profile list'"
        raise UsageError(f"`latency`: '{written}' should be {kinds}")
    return Source(written, profile=written, tokens=tokens, weights=load_profile(written).weights)
