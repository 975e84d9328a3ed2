"""Scenarios, a folder each (ccrb), in simulators with one control interface.

Arrays hold M roll-outs in lock step; `LEAD`, `EGO` and `REAR` index the cars. SI units, float seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from s2a_bench.frames import FrameSource
from s2a_bench.policy import Floats
from s2a_bench.policy.parameters import build
from s2a_bench.registry import Registry

LEAD, EGO, REAR = 0, 1, 2
ROLES: Final = ("lead", "ego", "rear")
STEP_S: Final = 0.005
"""Default step of the simulators."""
LANE_WIDTH_M: Final = 4.0


@dataclass(frozen=True, slots=True)
class State:
    """State of the three cars, arrays of shape (3, M)."""

    position_m: Floats
    """Along the lane, bumper to bumper: a difference of positions is a gap (zero car length)."""
    speed_mps: Floats
    """0 or more."""
    lateral_m: Floats
    """The distance from the middle of the starting lane, to the left."""

    def keep(self, columns: NDArray[np.int64]) -> State:
        return State(self.position_m[:, columns], self.speed_mps[:, columns], self.lateral_m[:, columns])


@dataclass(frozen=True, slots=True)
class DriveCommand:
    acceleration_mps2: Floats
    """Shape (3, M)."""
    lane: NDArray[np.int64]
    """The ego's target lane, shape (M,): 0 the starting lane, 1 to its left."""


class Simulator(Protocol):
    """A world of three cars; its parameters, if any, are the fields of a dataclass, all with defaults."""

    name: ClassVar[str]
    """The key in SIMULATORS."""
    real: ClassVar[bool]
    """Whether it has physics of its own, so that cars follow a command with an error; else they follow exactly."""
    steers: ClassVar[bool]
    """Whether cars can leave their lane."""
    most: ClassVar[int | None] = None
    """Most roll-outs in lock step; None: no limit."""
    over_ros: ClassVar[bool] = False
    """Whether its ego can be driven and seen over ROS 2; `step` then takes NaN as its acceleration."""
    step_s: float = STEP_S

    def place(self, position_m: Floats, speed_mps: Floats) -> State:
        """Restart with the cars in one lane, arrays of shape (3, M)."""

    def step(self, command: DriveCommand) -> State:
        """Simulate one step; cars brake to a stop, never backwards."""

    def camera(self, width: int, height: int) -> FrameSource:
        """Open a camera with the ego's view, of the first roll-out; closing it leaves the world alone.

        Each `read`, once cars are placed, delivers the current state, stamped at that moment, in the camera's own
        encoding. Raises UsageError naming `size` if it is impossible, and `simulator` if the world cannot be seen.
        """

    def close(self) -> None:
        """Let go of the world, and restore what was changed outside of it; may be called twice."""
        return


SIMULATORS: Final[Registry[type[Simulator]]] = Registry(
    "simulators",
    "simulator",
    {
        "longitudinal": "s2a_bench.scenario.longitudinal:Longitudinal",
        "embedded": "s2a_bench.scenario.embedded:Embedded",
    },
)


def simulator_class(written: str) -> type[Simulator]:
    """Return the class of the simulator ``name[?parameter=value&...]``; raises UsageError for an unknown name."""
    return SIMULATORS[written.partition("?")[0]]


def open_simulator(written: str) -> Simulator:
    """Open the simulator ``name[?parameter=value&...]``; raises S2AError."""
    return build(simulator_class(written), written, SIMULATORS.field)
