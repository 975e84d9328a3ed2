"""Scenarios, a folder each (ccrb), in simulators with one control interface.

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
"""Default step of the simulators."""


@dataclass(frozen=True, slots=True)
class State:
    """State of the three cars, arrays of shape (3, M)."""

    position_m: Floats
    """Along the lane, bumper to bumper: a difference of positions is a gap (zero car length)."""
    speed_mps: Floats
    """0 or more."""
    lateral_m: Floats
    """From the middle of the starting lane, to the left."""

    def keep(self, columns: NDArray[np.int64]) -> State:
        return State(self.position_m[:, columns], self.speed_mps[:, columns], self.lateral_m[:, columns])


@dataclass(frozen=True, slots=True)
class DriveCommand:
    """Commands to the cars for one step."""

    acceleration_mps2: Floats
    """Shape (3, M)."""
    lane: NDArray[np.int64]
    """The ego's target lane, shape (M,): 0 the starting lane, 1 to its left."""


class Simulator(Protocol):
    """A world of three cars."""

    name: ClassVar[str]
    """As in SIMULATORS."""
    steers: ClassVar[bool]
    """Whether cars can leave their lane."""
    most: ClassVar[int | None]
    """Most roll-outs in lock step; None: no limit."""
    step_s: float

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Restart with the cars in one lane, arrays of shape (3, M)."""

    def step(self, command: DriveCommand) -> State:
        """Simulate one step; cars brake to a stop, never backwards."""


SIMULATORS: dict[str, str] = {
    "longitudinal": "s2a_bench.scenario.longitudinal:Longitudinal",
    "embedded": "s2a_bench.scenario.embedded:Embedded",
}
"""Value of ``--simulator`` -> constructor."""


def simulator(name: str) -> Simulator:
    """Build a simulator; raises UsageError for an unknown name."""
    if name not in SIMULATORS:
        raise UsageError(f"`simulator`: {none_of(name, SIMULATORS)}")
    build: Callable[..., Simulator] = resolve_name(SIMULATORS[name])
    return build()
