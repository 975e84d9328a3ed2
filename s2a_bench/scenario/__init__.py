"""Where it is tried: scenarios, a folder each (ccrb), in simulators that share one control interface.

Arrays hold M roll-outs in lock step; `LEAD`, `EGO` and `REAR` index the cars. SI units, float seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar, Final, Protocol

from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats
from s2a_bench.text import none_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEAD, EGO, REAR = 0, 1, 2
ROLES: Final = ("lead", "ego", "rear")
STEP_S: Final = 0.005
"""The step that simulators take unless told otherwise."""


@dataclass(frozen=True, slots=True)
class State:
    """Where the three cars are, arrays of shape (3, M)."""

    position_m: Floats
    """Along the lane, bumper to bumper: a difference of positions is a gap, as if cars had no length."""
    speed_mps: Floats
    """0 or more."""
    lateral_m: Floats
    """From the middle of the lane in which all start, to the left."""

    def keep(self, columns: NDArray[np.int64]) -> State:
        """Return some of the roll-outs."""
        return State(self.position_m[:, columns], self.speed_mps[:, columns], self.lateral_m[:, columns])


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """What the cars do for one step."""

    acceleration_mps2: Floats
    """Shape (3, M)."""
    lane: NDArray[np.int64]
    """The lane that the ego steers for, shape (M,): 0 the one in which all start, 1 to its left."""


class Simulator(Protocol):
    """A world of three cars."""

    name: ClassVar[str]
    """As in SIMULATORS."""
    steers: ClassVar[bool]
    """Whether cars can leave their lane."""
    most: ClassVar[int | None]
    """How many roll-outs it runs in lock step; None: as many as wanted."""
    step_s: float

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Begin anew with cars in one lane, arrays of shape (3, M)."""

    def step(self, command: DriveCommand) -> State:
        """Let one step pass; cars brake to a stop, never backwards."""

    def close(self) -> None:
        """Let go of what the world holds; it can be called twice."""


SIMULATORS: dict[str, str] = {
    "longitudinal": "s2a_bench.scenario.longitudinal:Longitudinal",
    "embedded": "s2a_bench.scenario.embedded:Embedded",
    "carla": "s2a_bench.scenario.carla:Carla",
}
"""Value of ``--simulator`` -> what builds it."""


def simulator(name: str, **settings: object) -> Simulator:
    """Build a simulator with its defaults or other settings; raises UsageError for an unknown name."""
    if name not in SIMULATORS:
        raise UsageError(f"`simulator`: {none_of(name, SIMULATORS)}")
    build: Callable[..., Simulator] = resolve_name(SIMULATORS[name])
    return build(**settings)
