"""The laws of the car behind against their published formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from s2a_bench.scenario.ccrb.cars import Cars
from s2a_bench.scenario.ccrb.follower import CarMotion, DriverView, Hdm, Hybrid, Idm, idm_acceleration

CARS = Cars(speed_mps=14.0, rear_gap_m=20.0, reaction_s=0.8)


def motion(position: float, speed: float, acceleration: float) -> CarMotion:
    return CarMotion(*(np.array([value]) for value in (position, speed, acceleration)))


SEEN = DriverView(
    ego=motion(60.0, 11.0, -3.0),
    rear=motion(40.0, 13.0, -0.5),
    ego_then=motion(50.0, 12.0, -1.0),
    rear_then=motion(30.0, 13.5, -0.25),
)


def wish(gap_m: float, speed: float, closing: float) -> float:
    """Return the IDM's acceleration with the headway that keeps 20 m at 14 m/s."""
    headway_s = (20 * (1 - 1.2**-4) ** 0.5 - 2.0) / 14.0
    arguments = (np.array([value]) for value in (gap_m, speed, closing, 1.2 * 14.0, headway_s))
    return float(idm_acceleration(*arguments)[0])


@pytest.mark.parametrize(
    ("law", "gap_m", "speed", "closing"),
    [
        (Idm, 20.0, 13.0, 2.0),
        (Hdm, 20.0 - 0.8 * 1.5, 13.5 - 0.8 * 0.25, 1.5),  # s - T' dv, v + T' a, dv, all of T' ago
        (Hybrid, 50.0 + 0.8 * 12.0 - 40.0, 13.0, 1.0),
    ],
)
def test_each_law_is_the_idm_on_what_its_name_promises(
    law: type[Idm], gap_m: float, speed: float, closing: float
) -> None:
    wanted = wish(gap_m, speed, closing)
    assert -7 < wanted < 0
    assert law(CARS, 1).acceleration(SEEN, 10.0)[0] == pytest.approx(wanted)  # a step in which any brake builds up


def test_the_brake_builds_up_in_0_6_s() -> None:
    hard = replace(SEEN, ego=motion(41.0, 0.0, 0.0))
    assert Idm(CARS, 1).acceleration(hard, 0.1)[0] == pytest.approx(-7 * 0.1 / 0.6)
