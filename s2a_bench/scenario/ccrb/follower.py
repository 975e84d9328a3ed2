"""The car behind: laws by their published names, all with one brake; the rear outcome depends on them.

``careful`` (of this project, in the manner of UN Regulation 157): from the ego's state tau ago, extrapolated over tau
with its deceleration then, it computes the braking needed to stay 1 m behind (`needed`), and brakes with that, at most
7 m/s^2, once the ego brakes by more than 0.5 or more than 0.7 is needed, until it is no faster than the ego.

``idm``: the Intelligent Driver Model (Treiber, Hennecke and Helbing, Phys. Rev. E 62 (2000) 1805): no delay.

``hdm``: the delay and the temporal anticipation of the Human Driver Model for one leader, without its estimation errors
(Treiber, Kesting and Helbing, Physica A 360 (2006) 71): the IDM on s - tau dv, v + tau a, and dv, all of tau ago.

``hybrid`` (of this project): the IDM on the rear car's present state, and the ego of tau ago extrapolated at steady
speed. The speed is undelayed, the closing speed partly delayed.

The IDM's time headway keeps the rear gap of the scenario at v0, so the car starts in equilibrium; at rest behind a car
at rest it stays. Every brake gives at most 7 m/s^2, builds up at 7 / 0.6 and releases at 7 / 0.2 m/s^3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from s2a_bench.policy import Floats
from s2a_bench.scenario.ccrb.cars import Cars
from s2a_bench.scenario.longitudinal import LockStep, each

BRAKES_MPS2: Final = 0.5
"""Above this a car ahead counts as braking."""
LEAST_ROOM_M: Final = 0.05
MOST_MPS2: Final = 7.0
BUILD_S, RELEASE_S = 0.6, 0.2
SPARE_M: Final = 1.0
LEAST_MPS2: Final = 1e-6
"""Smaller decelerations count as zero."""
ACTS_MPS2: Final = 0.7
"""The careful driver brakes once more than this is needed."""
CATCH_UP_MPS2: Final = 1.0
"""The careful driver's acceleration when slower and farther away than at the start."""

IDM_ACCEL_MPS2, IDM_COMFORT_MPS2, IDM_STANDSTILL_M, IDM_EXPONENT = 1.5, 2.0, 2.0, 4
IDM_HASTE: Final = 1.2
"""Desired speed over v0: at the desired speed the IDM keeps no finite gap."""
IDM_LEAST_HEADWAY_S: Final = 0.1

AT_EASE: Final = "headway such that it keeps its gap at first"
BRAKE: Final = "at most 7 m/s\N{SUPERSCRIPT TWO}, built up in 0.6 s"


@dataclass(frozen=True, slots=True)
class CarMotion:
    """The motion of a car, arrays of shape (M,)."""

    position_m: Floats
    speed_mps: Floats
    acceleration_mps2: Floats


@dataclass(frozen=True, slots=True)
class DriverView:
    """Inputs of a law: ego and rear car now, and a reaction time ago."""

    ego: CarMotion
    rear: CarMotion
    ego_then: CarMotion
    rear_then: CarMotion


class Follower(LockStep):
    """A law for the trailing car of M roll-outs, with its brake, whose force builds up slowly and releases fast."""

    law: ClassVar[str]
    """Description of the law; ``{reaction:g}`` is the reaction time in s."""

    def __init__(self, cars: Cars, rollouts: int) -> None:
        self._reaction_s = each(cars.reaction_s, rollouts)
        self._force_mps2 = np.zeros(rollouts)

    def acceleration(self, seen: DriverView, step_s: float) -> Floats:
        """Return the acceleration in m/s^2 for the next step, shape (M,)."""
        raise NotImplementedError

    def brake(self, want_mps2: Floats, step_s: float) -> Floats:
        change = np.minimum(want_mps2, MOST_MPS2) - self._force_mps2
        self._force_mps2 += np.clip(change, -MOST_MPS2 / RELEASE_S * step_s, MOST_MPS2 / BUILD_S * step_s)
        return self._force_mps2.copy()


class Careful(Follower):
    law: ClassVar[str] = (
        "careful follower (ours): brakes as needed to stay 1 m behind the ego, seen {reaction:g} s ago and "
        f"extrapolated; {BRAKE}"
    )

    def __init__(self, cars: Cars, rollouts: int) -> None:
        super().__init__(cars, rollouts)
        self._far_m = each(cars.rear_gap_m, rollouts)
        self._braking = np.zeros(rollouts, bool)

    def acceleration(self, seen: DriverView, step_s: float) -> Floats:
        ego, rear = seen.ego_then, seen.rear
        decel = np.maximum(-ego.acceleration_mps2, 0.0)
        until_rest = np.divide(ego.speed_mps, decel, out=np.full(decel.shape, np.inf), where=decel > LEAST_MPS2)
        ahead_s = np.minimum(self._reaction_s, until_rest)
        ahead_m = ego.position_m + ego.speed_mps * ahead_s - decel * ahead_s * ahead_s / 2
        ahead_mps = np.maximum(ego.speed_mps - decel * ahead_s, 0.0)
        gap_m = ahead_m - rear.position_m
        need = needed(rear.speed_mps, gap_m - SPARE_M, ahead_mps, decel)
        alarmed = decel > BRAKES_MPS2
        faster = rear.speed_mps > ahead_mps + 1e-9
        self._braking |= alarmed | (need > ACTS_MPS2)
        self._braking &= faster | alarmed
        force = self.brake(np.where(self._braking, need, 0.0), step_s)
        idle = ~self._braking & (force <= 0) & (rear.speed_mps < ego.speed_mps) & (gap_m > self._far_m)
        return np.where(idle, CATCH_UP_MPS2, -force)


class Idm(Follower):
    law: ClassVar[str] = f"IDM follower on the present, without delay; {AT_EASE}; {BRAKE}"

    def __init__(self, cars: Cars, rollouts: int) -> None:
        super().__init__(cars, rollouts)
        speed = each(cars.speed_mps, rollouts)
        self._desired_mps = IDM_HASTE * speed
        at_ease_m = np.asarray(cars.rear_gap_m, float) * np.sqrt(1 - IDM_HASTE**-IDM_EXPONENT)
        self._headway_s = np.maximum((at_ease_m - IDM_STANDSTILL_M) / speed, IDM_LEAST_HEADWAY_S)

    def acceleration(self, seen: DriverView, step_s: float) -> Floats:
        gap_m, speed, closing, ahead = self._perceived(seen)
        wish = idm_acceleration(gap_m, speed, closing, self._desired_mps, self._headway_s)
        force = self.brake(np.maximum(-wish, 0.0), step_s)
        standing = (seen.rear.speed_mps <= 0) & (ahead.speed_mps <= 0)
        going = np.where(standing, 0.0, np.maximum(wish, 0.0))
        return np.where(force > 0, -force, going)

    def _perceived(self, seen: DriverView) -> tuple[Floats, Floats, Floats, CarMotion]:
        ego, rear = seen.ego, seen.rear
        return ego.position_m - rear.position_m, rear.speed_mps, rear.speed_mps - ego.speed_mps, ego


class Hdm(Idm):
    law: ClassVar[str] = (
        "HDM follower: IDM on the gap s - T' dv, the speed v + T' a and dv of T' = {reaction:g} s ago, one leader, no "
        f"estimation errors; {AT_EASE}; {BRAKE}"
    )

    def _perceived(self, seen: DriverView) -> tuple[Floats, Floats, Floats, CarMotion]:
        ego, rear, ago_s = seen.ego_then, seen.rear_then, self._reaction_s
        closing = rear.speed_mps - ego.speed_mps
        gap_m = ego.position_m - rear.position_m - ago_s * closing
        return gap_m, np.maximum(rear.speed_mps + ago_s * rear.acceleration_mps2, 0.0), closing, ego


class Hybrid(Idm):
    law: ClassVar[str] = (
        "hybrid follower (ours): IDM on its own state now and the ego seen {reaction:g} s ago, extrapolated at steady "
        f"speed; {AT_EASE}; {BRAKE}"
    )

    def _perceived(self, seen: DriverView) -> tuple[Floats, Floats, Floats, CarMotion]:
        ego, rear = seen.ego_then, seen.rear
        gap_m = ego.position_m + ego.speed_mps * self._reaction_s - rear.position_m
        return gap_m, rear.speed_mps, rear.speed_mps - ego.speed_mps, ego


def needed(speed_mps: Floats, room_m: Floats, ahead_mps: Floats, ahead_decel_mps2: Floats) -> Floats:
    """Return the least deceleration in m/s^2 that avoids the car ahead if that keeps its deceleration.

    With room r, speed v, and the speed w and deceleration A ahead: v^2 / (2 (r + w^2/(2A))) if the car ahead brakes
    (A > 0.5) and stops first; A + c^2 / (2 r), c = v - w, if it moves when the speeds meet; c^2 / (2 r) if it does not
    brake.
    """
    room = np.maximum(room_m, LEAST_ROOM_M)
    closing = np.maximum(speed_mps - ahead_mps, 0.0)
    kinetic = closing * closing / (2 * room)
    brakes = ahead_decel_mps2 > BRAKES_MPS2
    decel = np.where(brakes, ahead_decel_mps2, 1.0)
    to_rest = speed_mps * speed_mps / (2 * (room + ahead_mps * ahead_mps / (2 * decel)))
    stops_later = speed_mps * decel > ahead_mps * np.maximum(to_rest, 1e-9)
    moving = np.where(stops_later, to_rest, decel + kinetic)
    return np.asarray(np.where(brakes, moving, kinetic))


def idm_acceleration(
    gap_m: Floats, speed_mps: Floats, closing_mps: Floats, desired_mps: Floats, headway_s: Floats
) -> Floats:
    """Return a (1 - (v / v_des)^4 - (s* / s)^2) with s* = s0 + v T + v dv / (2 sqrt(a b))."""
    approach = speed_mps * closing_mps / (2 * np.sqrt(IDM_ACCEL_MPS2 * IDM_COMFORT_MPS2))
    wanted_m = np.maximum(IDM_STANDSTILL_M + speed_mps * headway_s + approach, 0.0)
    share = wanted_m / np.maximum(gap_m, 0.01)
    return np.asarray(IDM_ACCEL_MPS2 * (1 - (speed_mps / desired_mps) ** IDM_EXPONENT - share * share))
