"""What a control loop sends actions to, one a control tick: a simulated plant, a ROS 2 topic, a Python function.

    robot = open_robot("plant?frequency_hz=3", dims=7, period_ns=20_000_000)
    robot.send(action, now_ns())     # in every tick; None where there is nothing to execute
    robot.state()                    # what the next request tells the policy
    robot.close()

A robot that carries out skills, each of which takes a while, is `runtime.Robot`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol

from s2a_bench.registry import Registry

if TYPE_CHECKING:
    from s2a_bench.types import Vector


class Robot(Protocol):
    """What carries actions out. One thread, the control loop's, calls it, and every call returns at once."""

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Execute an action, float32 (D,), from ``at_ns`` (CLOCK_MONOTONIC) until the next tick; called in every tick.

        None is a stall: hold. The array is only lent. Raises S2AError, which ends the run.
        """
        ...

    def state(self) -> tuple[float, ...]:
        """Return what a request tells the policy of the robot, in the robot's own units; empty: nothing."""
        ...

    def describe(self) -> dict[str, str]:
        """Return what it is, for the manifest."""
        ...

    def close(self) -> None:
        """Let go of the robot; may be called twice."""
        ...


class Kind(Protocol):
    """A kind of robot with its parameters, which are its fields and all have defaults."""

    @property
    def name(self) -> str:
        """Return its name, as in ROBOTS."""
        ...

    def open(self, dims: int, period_ns: int) -> Robot:
        """Open a robot for actions of ``dims`` numbers, one every ``period_ns``; raises S2AError."""
        ...


ROBOTS: Final[Registry[Callable[..., Kind]]] = Registry(
    "action_robots",
    "robot",
    {
        "plant": "s2a_bench.robots.plant:Plant",
        "ros": "s2a_bench.robots.ros:Ros",
        "call": "s2a_bench.robots.call:Call",
    },
)
"""What builds each kind from its parameters. Those that carry out skills are in `runtime.ROBOTS`."""


def kind(written: str) -> Kind:
    """Build the kind ``name[?parameter=value&...]``; raises UsageError for an unknown name, parameter or value."""
    from s2a_bench.policy.parameters import build

    return build(ROBOTS[written.partition("?")[0]], written, ROBOTS.field)


def open_robot(written: str, dims: int, period_ns: int) -> Robot:
    """Open the robot ``name[?parameter=value&...]``; raises S2AError for what the caller can mend."""
    return kind(written).open(dims, period_ns)
