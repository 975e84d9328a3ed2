"""Parameters with which a robot, a camera or an ego joins a domain; middlewares declare some of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, make_dataclass
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

from pydantic import Field

from s2a_bench.errors import UsageError
from s2a_bench.ros import MIDDLEWARES, Middleware, middleware_kind, open_middleware
from s2a_bench.text import none_of

T = TypeVar("T")
PLACES: Final = {name: kind.meeting_place for name, kind in MIDDLEWARES.loaded() if kind.meeting_place}
"""Middleware -> where its nodes meet."""


@dataclass(frozen=True, slots=True)
class DomainParameters:
    middleware: str = ""
    domain_id: Annotated[int, Field(ge=0, le=232)] | None = None


if TYPE_CHECKING:
    PlaceParameters = DomainParameters
else:
    named = {at.option: (at.option, str, at.default) for at in PLACES.values()}
    PlaceParameters = make_dataclass(
        "PlaceParameters", named.values(), bases=(DomainParameters,), frozen=True, slots=True
    )


@dataclass(frozen=True, slots=True)
class RosParameters(PlaceParameters):
    """Parameters for joining a domain, with the ROS transport's defaults; ``wait_s`` is the longest wait for a peer."""

    wait_s: Annotated[float, Field(gt=0, le=3600)] = 10.0

    def __post_init__(self) -> None:
        if self.middleware and self.middleware not in MIDDLEWARES:
            raise UsageError(f"middleware = {none_of(self.middleware, MIDDLEWARES)}")
        for at in PLACES.values():
            at.check(getattr(self, at.option))

    def join(self, name: str, opened: Callable[[Middleware], T]) -> T:
        """Return the result of ``opened`` for a new node called ``name``; if it raises, the node leaves."""
        place = middleware_kind(self.middleware).place_in(self)
        node = open_middleware(self.middleware, domain_id=self.domain_id, node_name=name, place=place)
        try:
            return opened(node)
        except BaseException:
            node.close()
            raise
