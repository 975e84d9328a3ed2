"""How a robot, a camera or an ego joins a domain: parameters, of which some are declared by middlewares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, make_dataclass
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

from pydantic import Field

from s2a_bench.errors import UsageError
from s2a_bench.ros import MIDDLEWARES, MeetingPlace, Middleware, chosen, open_middleware
from s2a_bench.text import none_of

T = TypeVar("T")
PLACES: Final[dict[str, MeetingPlace]] = {
    kind.meeting_place.option: kind.meeting_place for _, kind in MIDDLEWARES.loaded() if kind.meeting_place
}
"""Option -> the meeting place that it names."""


@dataclass(frozen=True, slots=True)
class DomainParameters:
    middleware: str = ""
    domain_id: Annotated[int, Field(ge=0, le=232)] | None = None


if TYPE_CHECKING:
    PlaceParameters = DomainParameters
else:
    fields = [(name, str, place.default) for name, place in PLACES.items()]
    PlaceParameters = make_dataclass("PlaceParameters", fields, bases=(DomainParameters,), frozen=True, slots=True)


@dataclass(frozen=True, slots=True)
class RosParameters(PlaceParameters):
    """How to join a domain, the defaults as of the ROS transport; a peer is waited for ``wait_s``."""

    wait_s: Annotated[float, Field(gt=0, le=3600)] = 10.0

    def __post_init__(self) -> None:
        if self.middleware and self.middleware not in MIDDLEWARES:
            raise UsageError(f"middleware = {none_of(self.middleware, MIDDLEWARES)}")
        for name, place in PLACES.items():
            place.check(getattr(self, name))

    def join(self, name: str, opened: Callable[[Middleware], T]) -> T:
        """Return what ``opened`` makes of a node called ``name``; if it raises, the node leaves."""
        place = chosen(self.middleware).place_in(self)
        node = open_middleware(self.middleware, domain_id=self.domain_id, node_name=name, place=place)
        try:
            return opened(node)
        except BaseException:
            node.close()
            raise
