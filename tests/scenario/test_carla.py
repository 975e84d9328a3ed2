"""The CARLA adapter against a stand-in: what it asks of a server, and what it says where there is none."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from s2a_bench.errors import MissingExtra, SimulatorError, UsageError
from s2a_bench.policy import Schedule
from s2a_bench.scenario.carla import Carla
from s2a_bench.scenario.ccrb.cars import Cars, braking_plan
from s2a_bench.scenario.ccrb.drive import drive
from tests.scenario.carla_stand_in import World, package

START = np.array([[40.0], [0.0], [-14.0]])


def connect(monkeypatch: pytest.MonkeyPatch, world: World | None, host: str = "localhost:2000") -> Carla:
    monkeypatch.setitem(sys.modules, "carla", package(world))
    return Carla(host)


def test_without_the_package_the_way_to_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(MissingExtra, match=r"pip install '.\[carla\]'"):
        Carla()


def test_without_a_server_its_address_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SimulatorError, match=r"`host` robot:2100: no CARLA server answers .*start one"):
        connect(monkeypatch, None, "robot:2100")


def test_a_port_that_is_no_number_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="'robot:x' should be HOST or HOST:PORT"):
        connect(monkeypatch, World(), "robot:x")


def test_the_world_runs_in_step_and_gets_its_settings_back(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    adapter = connect(monkeypatch, world)
    assert (world.settings.synchronous_mode, world.settings.fixed_delta_seconds) == (True, adapter.step_s)
    adapter.place(START, np.full((3, 1), 10.0))
    assert len(world.actors) == 3
    adapter.close()
    assert (world.settings.synchronous_mode, world.actors) == (False, [])


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ({"straight_m": 200.0}, "no straight lane of 250 m"),
        ({"full": True}, "no space to spawn the ego car"),
        ({"gone": True}, "the server has disconnected"),
    ],
)
def test_a_world_that_cannot_be_driven_in_is_told(
    fault: dict[str, float], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World()
    adapter = connect(monkeypatch, world)
    vars(world).update(fault)
    with pytest.raises(SimulatorError, match=told):
        adapter.place(START, np.zeros((3, 1)))


def test_the_operating_point_comes_out_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    start_s = 3.55 + 0.8 * np.arange(5)[:, np.newaxis]
    cars = Cars()
    schedule = Schedule(start_s, np.full((5, 1), 0.8))
    driven = drive(connect(monkeypatch, World()), cars, braking_plan(cars, 5, 0.8), schedule)
    assert driven.outcomes.name(0) == "none"
    assert driven.outcomes.min_front_gap_m[0] == pytest.approx(13.4, rel=0.1)
