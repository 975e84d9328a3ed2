"""The surroundings of a run of requests, from installed packages alone: a network between its ends, another clock.

The options of each kind are fields of every configuration of requests. `Surroundings.of` makes of them an object with
what a run is within; views show what each kind knows of a kept run, within it or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, ClassVar, Final, Protocol, TypeAlias

from s2a_bench.options import Options
from s2a_bench.provenance import Provenance
from s2a_bench.registry import Registry
from s2a_bench.trace import Trace
from s2a_bench.transport.pipeline import Pipeline

Exchange: TypeAlias = Callable[[str], Trace]
"""Makes a request that our server answers without its engine, for its marks; raises S2AError.

The argument is one of `machine.clocks.WALL_CLOCKS`, by which the server then bounds its wall clock, or "".
"""


@dataclass(frozen=True, slots=True)
class Joined:
    """The error bounds of a report's stamps, once they are on this host's clock."""

    error_ns: int
    """The bound from the last byte packed to the first piece, in both directions."""
    early_ns: int
    late_ns: int
    """How much earlier and later the true times may be, from the reception of the frame to the last piece."""


class OtherClock(Protocol):
    """The clock of one session's server, if it is on another host."""

    def refresh(self) -> None:
        """Learn more of it, between two requests."""

    def join(self, trace: Trace, last_ns: int) -> Joined:
        """Put a request's report on this host's clock; the last piece was seen at ``last_ns``.

        Raises a TransportError if that cannot be done.
        """


class Around:
    """The surroundings of one run while it lasts: by default nothing."""

    def facts(self, say: Callable[[str], None]) -> Mapping[str, Any]:
        """Return entries of the manifest, before servers start; ``say`` what takes time."""
        del say
        return {}

    def server_side(self) -> AbstractContextManager[None]:
        """Return the context within which servers are started."""
        return nullcontext()

    def origin(self, origin: Provenance) -> Provenance:
        """Return the provenance of a server that was started so."""
        return origin

    def totals(self) -> Mapping[str, Any]:
        """Return entries of the manifest at the end of a launch."""
        return {}


class Surroundings:
    """A kind of surroundings; an object has what one configuration asks for, and is sent to other processes."""

    options: ClassVar[type[Options]]
    """A run's; each names its ``panel``."""
    columns: ClassVar[str] = ""
    """A function of a kept run and its samples, which returns these with further columns; as "module:attribute"."""
    reads: ClassVar[Sequence[str]] = ()
    """The columns of the samples that it needs; without any it gets all."""
    metrics: ClassVar[str] = ""
    """The `RequestMetric`s of these columns."""
    figures: ClassVar[str] = ""
    """A function of a kept run that returns, by name, what draws the figures that latency also has."""

    @classmethod
    def of(cls, config: Any, pipelines: Sequence[Pipeline]) -> Surroundings | None:
        """Return the surroundings that a configuration, which has ``options``, asks for; None: none.

        Raises UsageError, naming the field, for what a pipeline cannot have.
        """
        raise NotImplementedError

    def around(self) -> AbstractContextManager[Around]:
        """Return the context that the thread of the requests enters, before a source of pictures is opened."""
        return nullcontext(Around())

    def clock(self, exchange: Exchange, shared: dict[str, Any] | None) -> OtherClock | None:
        """Return the object that puts the reports of a session's server on this host's clock.

        ``shared`` is what the sessions of a launch keep together; None: no exchange may be made beside the requests.
        """
        del exchange, shared
        return None


SURROUNDINGS: Final[Registry[type[Surroundings]]] = Registry("surroundings", "surroundings", {})


def shown(what: str) -> Iterator[Any]:
    """Yield the ``columns``, ``metrics`` or ``figures`` of each kind that has them."""
    for _, each in SURROUNDINGS.loaded():
        if name := getattr(each, what):
            yield resolve_name(name)
