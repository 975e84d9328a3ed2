"""A simulated robot: equal second-order joints that follow actions held from one control tick to the next.

x'' = w^2 (u - x) - 2 zeta w x' models a position-controlled joint. Within a tick u is constant, and the solution exact
at any step (zero-order hold). The plant begins at rest at its first action, and counts in ticks: an action lasts one
control period, whatever the clock.

A jump of the action makes the acceleration jump, and its derivative infinite. Jerk is therefore the change of the
acceleration over one control period, divided by that period, as a controller at the control rate measures it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import pi
from typing import Annotated, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from s2a_bench.act import ActionKind, ActionRobot, Motion
from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats
from s2a_bench.types import Vector

SUBSTEPS: Final = 8
"""Samples of the motion per control tick."""


@dataclass(frozen=True, slots=True)
class Plant(ActionKind):
    """Joints with an undamped natural frequency and a damping ratio, 1 for the fastest motion without overshoot."""

    simulated: ClassVar[bool] = True

    frequency_hz: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] = 5.0
    damping: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 1.0

    def open_actions(self, dims: int, period_ns: int) -> PlantRobot:
        return PlantRobot(self, dims, period_ns)

    def respond(self, actions: Floats, period_s: float) -> Motion:
        from scipy.signal import lfilter, ss2tf

        if np.isnan(actions[0]).any():
            raise ValueError("nothing to hold: the first action is NaN")
        rows = np.where(np.isnan(actions), 0, np.arange(len(actions))[:, np.newaxis])
        held = np.take_along_axis(np.asarray(actions, np.float64), np.maximum.accumulate(rows, axis=0), axis=0)
        rest = held[0]
        moved = held - rest
        steps, drives = zip(
            *(transition(self, period_s * step / SUBSTEPS) for step in range(SUBSTEPS + 1)), strict=True
        )
        numerators, denominator = ss2tf(steps[-1], drives[-1], np.eye(2), np.zeros((2, 1)))
        begins = np.stack([lfilter(numerator, denominator, moved, axis=0) for numerator in numerators])
        within = np.einsum("nij,jkd->iknd", np.stack(steps[:-1]), begins)
        within += np.einsum("nij,jkd->iknd", np.stack(drives[:-1]), moved[np.newaxis])
        position, velocity = within
        rate = 2 * pi * self.frequency_hz
        acceleration = rate**2 * (moved[:, np.newaxis] - position) - 2 * self.damping * rate * velocity
        jerk = np.diff(acceleration, axis=0, prepend=0.0) / period_s
        return Motion(position + rest, velocity, acceleration, jerk)


@cache
def transition(plant: Plant, step_s: float) -> tuple[Floats, Floats]:
    """Return A (2, 2) and B (2, 1) of [position, velocity] after ``step_s`` under a constant action."""
    from scipy.signal import cont2discrete

    rate = 2 * pi * plant.frequency_hz
    system = np.array([[0.0, 1.0], [-(rate**2), -2 * plant.damping * rate]])
    drive = np.array([[0.0], [rate**2]])
    stepped, driven, *_ = cont2discrete((system, drive, np.eye(2), np.zeros((2, 1))), step_s, method="zoh")
    return np.asarray(stepped), np.asarray(driven)


class PlantRobot(ActionRobot):
    """A plant that takes one action per tick; at rest at 0 before the first."""

    def __init__(self, plant: Plant, dims: int, period_ns: int) -> None:
        self._plant, self._dims, self._period_s = plant, dims, period_ns / 1e9
        self._step, self._drive = transition(plant, self._period_s)
        self._state: NDArray[np.float64] = np.zeros((2, dims))
        self._held: NDArray[np.float64] | None = None
        self._sent: list[NDArray[np.float64]] = []

    def send(self, action: Vector | None, at_ns: int) -> None:
        """Simulate one tick, from the first action on; raises UsageError for another shape."""
        del at_ns
        if action is not None:
            if action.shape != (self._dims,):
                raise UsageError(f"`robot`: plant: an action of shape {action.shape} for {self._dims} joints")
            if self._held is None:
                self._state[0] = action
            self._held = action.astype(np.float64)
        if self._held is not None:
            self._state = self._step @ self._state + self._drive * self._held
            self._sent.append(self._held)

    @property
    def actions(self) -> Floats:
        return np.array(self._sent).reshape(-1, self._dims)

    def moved(self, most: int) -> tuple[Motion, Floats] | None:
        actions = self.actions[:most]
        return (self._plant.respond(actions, self._period_s), actions) if self._sent else None

    def state(self) -> tuple[float, ...]:
        return tuple(self._state[0].tolist())

    def describe(self) -> dict[str, str]:
        plant = self._plant
        return {"robot": "plant", "frequency_hz": f"{plant.frequency_hz:g}", "damping": f"{plant.damping:g}"}

    def close(self) -> None: ...
