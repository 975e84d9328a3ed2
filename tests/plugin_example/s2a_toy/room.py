"""The surroundings `toy-room`: a run's manifest has the size of its room, its samples a column."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.experiments.requests import RequestMetric
from s2a_bench.options import Options, option
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.transport.surroundings import Around, Surroundings

METRICS = (RequestMetric(about="What sound takes through the room.", unit="ms", name="toy_walk"),)
SOUND_M_PER_S = 343.0


class RoomOptions(Options):
    """The room."""

    toy_room: float = option(0.0, "metres of the room in which a run is made [default: none]", ge=0, panel="Transport")


class InRoom(Around):
    """A run in a room."""

    def __init__(self, metres: float) -> None:
        """Know the room."""
        self._metres = metres

    def facts(self, say: Callable[[str], None]) -> Mapping[str, Any]:
        """Enter the room."""
        say("entering the room")
        return {"toy_room": self._metres}


@dataclass(frozen=True, slots=True)
class ToyRoom(Surroundings):
    """A room of so many metres."""

    metres: float

    options: ClassVar[type[Options]] = RoomOptions
    columns: ClassVar[str] = "s2a_toy.room:walked"
    metrics: ClassVar[str] = "s2a_toy.room:METRICS"

    @classmethod
    def of(cls, config: RoomOptions, pipelines: Sequence[Pipeline]) -> ToyRoom | None:
        """Take a room for few pipelines."""
        if config.toy_room and len(pipelines) > 3:
            raise UsageError("`toy_room` has place for three pipelines")
        return cls(config.toy_room) if config.toy_room else None

    def around(self) -> AbstractContextManager[Around]:
        """Be in it."""
        return nullcontext(InRoom(self.metres))


def walked(run: Any, samples: Any) -> Any:
    """Add the column of samples in a room."""
    metres = run.manifest.get("toy_room")
    return samples if metres is None else samples.assign(toy_walk_ns=1e9 * metres / SOUND_M_PER_S)
