"""How hard a car must brake behind another one: the arithmetic that the follower and the ego's reflex share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from s2a_bench.policy import Floats

BRAKES_MPS2: Final = 0.5
"""Above this a car ahead counts as braking."""
LEAST_ROOM_M: Final = 0.05


def needed(speed_mps: Floats, room_m: Floats, ahead_mps: Floats, ahead_decel_mps2: Floats) -> Floats:
    """Return the deceleration in m/s^2 that just avoids the car ahead, which goes on braking as it does.

    With room r, own speed v, the other's w and A: where it brakes (A > .5) and stops first, v^2 / (2 (r + w^2/(2A)));
    where it would still move when the speeds meet, A + c^2 / (2 r), c = v - w; where it does not brake, c^2 / (2 r).
    """
    room = np.maximum(room_m, LEAST_ROOM_M)
    closing = np.maximum(speed_mps - ahead_mps, 0.0)
    kinetic = closing * closing / (2 * room)
    brakes = ahead_decel_mps2 > BRAKES_MPS2
    decel = np.where(brakes, ahead_decel_mps2, 1.0)
    to_rest = speed_mps * speed_mps / (2 * (room + ahead_mps * ahead_mps / (2 * decel)))
    stops_later = speed_mps * decel > ahead_mps * np.maximum(to_rest, 1e-9)
    moving = np.where(stops_later, to_rest, decel + kinetic)
    need: Floats = np.where(brakes, moving, kinetic)
    return need
