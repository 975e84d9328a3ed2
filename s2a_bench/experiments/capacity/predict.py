"""The service times of a prediction, and how many robots they carry."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.boards.latency import STRETCH, read_delays
from s2a_bench.errors import UsageError
from s2a_bench.experiments.capacity.simulate import ServiceTime
from s2a_bench.experiments.latencies import Source, sources

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import Ints

MOST_BATCH: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Service:
    """How long a server takes: times of shape (R, 3), as `ServiceTime`, recorded in order or drawn from a source."""

    source: Source
    recorded_ns: Ints | None

    @staticmethod
    def read(written: str) -> Service:
        """Read one source as users write it; raises S2AError naming the field."""
        with _named("predict"):
            found = list(sources(written, 1))
        source = found[0]
        if len(found) > 1:
            raise UsageError(f"`predict`: {written} has several cells; name one of {', '.join(s.name for s in found)}")
        if source.profile:
            raise UsageError(f"`predict`: {written} is a profile of tokens; give service times, or a run folder")
        return Service.of(source)

    @staticmethod
    def of(source: Source) -> Service:
        """Take the engine's times of measured requests, and the whole latency where a server sends no marks."""
        recorded_ns = source.service_ns
        if recorded_ns is None and (latency_ns := source.recorded_ns) is not None:
            recorded_ns = np.stack([latency_ns, latency_ns, np.zeros_like(latency_ns)], 1)
        found = Service(source, recorded_ns)
        if not found.mean_ns:
            raise UsageError(f"`predict`: {source.name} takes no time; it would carry any number of robots")
        return found

    @property
    def mean_ns(self) -> float:
        if self.recorded_ns is not None:
            return float(self.recorded_ns[:, 1].mean())
        return float(self.source.draw(np.random.default_rng(0), STRETCH).mean())

    @property
    def about(self) -> str:
        """What a service time is."""
        if self.source.requests and self.source.service_ns is None:
            return "the whole latency of one robot, as the server sends no marks: what is spent beside it counts too"
        return "from the engine's start to its last piece" if self.source.requests else "as given"

    def times(self, rng: np.random.Generator) -> Iterator[ServiceTime]:
        """Return endless service times; a recording is played from a random request on, again and again."""
        if self.recorded_ns is not None:
            turned = np.roll(self.recorded_ns, -int(rng.integers(len(self.recorded_ns))), axis=0)
            return chain.from_iterable(repeat([ServiceTime(*row) for row in turned.tolist()]))
        draws = (self.source.draw(rng, STRETCH).tolist() for _ in repeat(None))
        return (ServiceTime(each, each) for each in chain.from_iterable(draws))


def read_batches(path: Path) -> Sequence[float]:
    """Read by how many times longer 1, 2, ... requests take together than one; raises UsageError naming `batch`.

    The CSV file has a column ``batch`` and one of `boards.latency`; sizes between those of its rows are interpolated.
    """
    with _named("batch"):
        latency_ns = read_delays(path)
    with path.open(encoding="utf-8-sig", newline="") as file:
        written = [row.get("batch") or "" for row in csv.DictReader(file)]
    sizes = [int(each) for each in written if each.isdecimal() and 1 <= int(each) <= MOST_BATCH]
    if len(sizes) < len(written) or sizes[0] != 1 or sorted({*sizes}) != sizes or not latency_ns.all():
        raise UsageError(
            f"`batch`: {path} needs a column batch with 1 and larger sizes, ascending, up to {MOST_BATCH}, "
            "and times above 0"
        )
    found: list[float] = (np.interp(np.arange(1, sizes[-1] + 1), sizes, latency_ns) / latency_ns[0]).tolist()
    return found


@contextmanager
def _named(field: str) -> Iterator[None]:
    """Name the field in errors about latencies."""
    try:
        yield
    except UsageError as error:
        raise UsageError(str(error).replace("`latency`", f"`{field}`")) from error
