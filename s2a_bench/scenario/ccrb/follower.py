"""The car behind: it acts on what it saw a reaction time ago, by a law that the rear outcome hangs on.

``careful``, in the manner of UN Regulation 157: from the ego's state tau ago, extrapolated over tau with the
deceleration it had then, it computes the braking it needs to stay 1 m behind (`braking.needed`), and brakes with that,
at most 7 m/s^2, once the ego brakes by more than .5 or more than .7 is needed, until it is no faster than the ego.

``idm``: the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000) on the ego of tau ago, extrapolated at
steady speed (as in their Human Driver Model of 2006: without that, the delay alone makes it run into standing cars).
Its time headway is what keeps the rear gap of the scenario at v0, so that it is at ease in the beginning. At rest
behind a car at rest it stays.

Either way brake force builds up at 7 / .6 and goes at 7 / .2 m/s^3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar, Final, Protocol

import numpy as np

from s2a_bench.errors import UsageError
from s2a_bench.scenario.ccrb import FOLLOWERS
from s2a_bench.scenario.ccrb.braking import BRAKES_MPS2, needed
from s2a_bench.scenario.ccrb.cars import Cars
from s2a_bench.scenario.lockstep import LockStep

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats

MOST_MPS2: Final = 7.0
BUILD_S, RELEASE_S = 0.6, 0.2
SPARE_M: Final = 1.0
"""How far behind the ego the careful driver means to stay."""
ACTS_MPS2: Final = 0.7
"""The careful driver brakes once this much is needed."""
CATCH_UP_MPS2: Final = 1.0
"""How the careful driver closes up again when slower and farther away than in the beginning."""

IDM_ACCEL_MPS2, IDM_COMFORT_MPS2, IDM_STANDSTILL_M, IDM_EXPONENT = 1.5, 2.0, 2.0, 4
IDM_HASTE: Final = 1.2
"""Desired speed over v0: nobody keeps a steady gap at the speed that they would have alone."""
IDM_LEAST_HEADWAY_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class Seen:
    """What the driver acts on, arrays of shape (M,)."""

    ego_position_m: Floats
    ego_speed_mps: Floats
    ego_acceleration_mps2: Floats
    """These three as they were a reaction time ago."""
    position_m: Floats
    speed_mps: Floats
    """Its own, as they are."""


class Follower(Protocol):
    """A law for the trailing car of M roll-outs; it remembers from step to step."""

    law: ClassVar[str]
    """The law in words; ``{reaction:g}`` stands for the reaction time in s."""

    def acceleration(self, seen: Seen, step_s: float) -> Floats:
        """Return the acceleration in m/s^2 for the next step, shape (M,)."""
        ...

    def keep(self, columns: NDArray[np.int64]) -> None:
        """Go on with these roll-outs only."""
        ...


class Careful(LockStep):
    """The careful driver."""

    law: ClassVar[str] = (
        "careful follower: brakes as needed to stay 1 m behind the ego, seen {reaction:g} s ago and "
        "extrapolated; at most 7 m/s\N{SUPERSCRIPT TWO}, built up in 0.6 s"
    )

    def __init__(self, cars: Cars, rollouts: int) -> None:
        self._reaction_s = np.broadcast_to(np.asarray(cars.reaction_s, float), (rollouts,))
        self._far_m = np.broadcast_to(np.asarray(cars.rear_gap_m, float), (rollouts,))
        self._braking = np.zeros(rollouts, bool)
        self._force = np.zeros(rollouts)

    def acceleration(self, seen: Seen, step_s: float) -> Floats:
        """Predict the ego, and brake as needed."""
        decel = np.maximum(-seen.ego_acceleration_mps2, 0.0)
        until_rest = np.divide(
            seen.ego_speed_mps,
            decel,
            out=np.full(decel.shape, np.inf),
            where=decel > 1e-6,  # noqa: PLR2004 - none
        )
        ahead_s = np.minimum(self._reaction_s, until_rest)
        ahead_m = seen.ego_position_m + seen.ego_speed_mps * ahead_s - decel * ahead_s * ahead_s / 2
        ahead_mps = np.maximum(seen.ego_speed_mps - decel * ahead_s, 0.0)
        gap_m = ahead_m - seen.position_m
        need = needed(seen.speed_mps, gap_m - SPARE_M, ahead_mps, decel)
        alarmed = decel > BRAKES_MPS2
        faster = seen.speed_mps > ahead_mps + 1e-9
        self._braking |= alarmed | (need > ACTS_MPS2)
        self._braking &= faster | alarmed
        want = np.where(self._braking, np.minimum(need, MOST_MPS2), 0.0)
        self._force = apply_brake(self._force, want, step_s)
        idle = ~self._braking & (self._force <= 0) & (seen.speed_mps < seen.ego_speed_mps) & (gap_m > self._far_m)
        return np.where(idle, CATCH_UP_MPS2, -self._force)


class Idm(LockStep):
    """The Intelligent Driver Model with delay."""

    law: ClassVar[str] = (
        "IDM follower on the ego seen {reaction:g} s ago, headway such that it keeps its gap at first; "
        "at most 7 m/s\N{SUPERSCRIPT TWO}, built up in 0.6 s"
    )

    def __init__(self, cars: Cars, rollouts: int) -> None:
        speed = np.broadcast_to(np.asarray(cars.speed_mps, float), (rollouts,))
        self._reaction_s = np.broadcast_to(np.asarray(cars.reaction_s, float), (rollouts,))
        self._desired_mps = IDM_HASTE * speed
        at_ease_m = np.asarray(cars.rear_gap_m, float) * np.sqrt(1 - IDM_HASTE**-IDM_EXPONENT)
        self._headway_s = np.maximum((at_ease_m - IDM_STANDSTILL_M) / speed, IDM_LEAST_HEADWAY_S)
        self._force = np.zeros(rollouts)

    def acceleration(self, seen: Seen, step_s: float) -> Floats:
        """Balance the urge to go against the gap, as it would be had the ego kept its speed."""
        ahead_m = seen.ego_position_m + seen.ego_speed_mps * self._reaction_s
        gap_m = ahead_m - seen.position_m
        wish = idm_acceleration(gap_m, seen.speed_mps, seen.ego_speed_mps, self._desired_mps, self._headway_s)
        self._force = apply_brake(self._force, np.clip(-wish, 0.0, MOST_MPS2), step_s)
        standing = (seen.speed_mps <= 0) & (seen.ego_speed_mps <= 0)
        going = np.where(standing, 0.0, np.maximum(wish, 0.0))
        return np.where(self._force > 0, -self._force, going)


def idm_acceleration(
    gap_m: Floats, speed_mps: Floats, ahead_mps: Floats, desired_mps: Floats, headway_s: Floats
) -> Floats:
    """Return a (1 - (v / v_des)^4 - (s* / s)^2) with s* = s0 + v T + v (v - w) / (2 sqrt(a b))."""
    approach = speed_mps * (speed_mps - ahead_mps) / (2 * np.sqrt(IDM_ACCEL_MPS2 * IDM_COMFORT_MPS2))
    wanted_m = np.maximum(IDM_STANDSTILL_M + speed_mps * headway_s + approach, 0.0)
    share = wanted_m / np.maximum(gap_m, 0.01)
    return np.asarray(IDM_ACCEL_MPS2 * (1 - (speed_mps / desired_mps) ** IDM_EXPONENT - share * share))


def apply_brake(force_mps2: Floats, want_mps2: Floats, step_s: float) -> Floats:
    """Return the brake force after a step towards the wanted one: it builds up slowly and goes fast."""
    change = np.clip(want_mps2 - force_mps2, -MOST_MPS2 / RELEASE_S * step_s, MOST_MPS2 / BUILD_S * step_s)
    return force_mps2 + change


def follower(cars: Cars, rollouts: int) -> Follower:
    """Build the trailing car's law for M roll-outs; raises UsageError for an unknown name."""
    if cars.follower not in FOLLOWERS:
        raise UsageError(f"`follower`: '{cars.follower}' is none of {', '.join(FOLLOWERS)}")
    build: Callable[[Cars, int], Follower] = resolve_name(FOLLOWERS[cars.follower])
    return build(cars, rollouts)
