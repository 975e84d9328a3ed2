"""The CARLA simulator on a stand-in for its server. No server was there: docs/carla.md has the checklist."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import s2a_bench as s2a
from s2a_bench.errors import MissingExtra, S2AError, SimulatorError, SourceError, UsageError
from s2a_bench.plugins.carla.world import OPENDRIVE, CarlaWorld
from s2a_bench.policy import Schedule
from s2a_bench.scenario import EGO, LEAD, REAR, DriveCommand, State, open_simulator
from s2a_bench.scenario.ccrb.cars import Cars, braking_plan
from s2a_bench.scenario.ccrb.drive import Driven, drive
from s2a_bench.scenario.longitudinal import Longitudinal
from s2a_bench.testing.simulator import SPEED, START, SimulatorSuite, command, run
from tests.plugins.carla.stand_in import LATE_S, SERVER, fresh

TOWN = ("Town10HD_Opt", (False, None), [])
"""The stand-in's server before anything was done to it: map, settings, actors."""
LATER = "; start its server (CarlaUE4.sh), or name another one: carla?host=H&port=P&timeout_s=T"
TIMED_OUT = "time-out of 60000ms while waiting for the simulator"


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[CarlaWorld]:
    monkeypatch.setitem(sys.modules, "carla", fresh())
    with closing(CarlaWorld()) as world:
        yield world


class TestCarla(SimulatorSuite):
    """With the vectors of the real client where that is installed."""

    name = "carla"
    PLACED = 0.2
    """The loop around the ego's speed may not be at rest yet."""
    DRIVEN = 2.0
    """At 10 m/s a pedal that acts 0.2 s late is 2 m; below, the lead and the trailing car are held to centimetres."""
    RESTS = 1e-4
    """Float32 at hundreds of metres."""

    @pytest.fixture(autouse=True)
    def _server(self, monkeypatch: pytest.MonkeyPatch) -> None:
        client = importlib.import_module("carla") if find_spec("carla") else None
        monkeypatch.setitem(sys.modules, "carla", fresh(client))

    @classmethod
    def outside(cls) -> object:
        return SERVER.settings, [actor.id for actor in SERVER.actors]


def test_the_lead_and_the_trailing_car_follow_their_commands_to_centimetres(world: CarlaWorld) -> None:
    world.place(START, SPEED)
    state = run(world, 2.0, command(lead=-2.0, rear=-4.0))
    assert state.speed_mps[[LEAD, REAR], 0] == pytest.approx([6.0, 2.0], abs=1e-3)
    assert state.position_m[[LEAD, REAR], 0] == pytest.approx([56.0, -2.0], abs=0.1)


def test_the_cars_start_where_they_are_placed_though_a_cold_car_loses_speed(world: CarlaWorld) -> None:
    state = world.place(START, SPEED)
    assert state.position_m == pytest.approx(START, abs=0.01)
    assert state.speed_mps == pytest.approx(SPEED, abs=0.15)


def test_the_ego_brakes_late_and_the_error_shows(world: CarlaWorld) -> None:
    world.place(START, SPEED)
    late_m = run(world, 1.5, command(ego=-4.0)).position_m[EGO, 0] - (15.0 - 4.0 * 1.5**2 / 2)
    assert 0.1 < late_m < 10.0 * LATE_S
    speed = run(world, 0.5, command(ego=-4.0)).speed_mps[EGO, 0]
    assert speed == pytest.approx(2.0, abs=0.6)


def test_an_ego_that_is_driven_over_ros_is_left_alone(world: CarlaWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    world.place(START, SPEED)
    (ego,) = (actor for actor in SERVER.actors if actor is world._cars[EGO])
    monkeypatch.setattr(type(ego), "apply_control", None)
    state = run(world, 0.2, command(lead=-1.0, ego=np.nan))
    assert np.isfinite(state.position_m).all()
    names = {role: (given["role_name"], given["ros_name"]) for role, given in SERVER.attributes.items()}
    assert names["ego"] == ("ego", "ego")


def test_its_camera_is_published_over_ros_as_front(world: CarlaWorld) -> None:
    world.camera(64, 48)
    front = SERVER.attributes["front"]
    assert (front["ros_name"], front["over_ros"], front["fov"]) == ("front", "yes", "60.0")


def crash(world: CarlaWorld, *, of: int) -> tuple[list[State], int]:
    """Drive towards a standing lead, or let the trailing car run into the ego; return the states, and which touch."""
    gap = {LEAD: [[10.0], [0.0], [-100.0]], REAR: [[100.0], [0.0], [-10.0]]}[of]
    speed = {LEAD: [[0.0], [10.0], [10.0]], REAR: [[0.0], [0.0], [10.0]]}[of]
    states = [world.place(np.array(gap), np.array(speed))]
    states += [world.step(command()) for _ in range(80)]
    gaps = [abs(float(state.position_m[of, 0] - state.position_m[EGO, 0])) for state in states]
    return states, gaps.index(0.0)


@pytest.mark.parametrize("of", [LEAD, REAR])
@pytest.mark.parametrize("late", [False, True])
def test_a_contact_is_told_as_a_gap_of_0_with_the_speeds_before_it(world: CarlaWorld, of: int, late: bool) -> None:
    SERVER.late_events = late
    states, touches = crash(world, of=of)
    touching, after = states[touches], states[touches + 1]
    assert abs(float(touching.speed_mps[of, 0] - touching.speed_mps[EGO, 0])) == pytest.approx(10.0, abs=0.4)
    assert abs(float(after.speed_mps[of, 0] - after.speed_mps[EGO, 0])) < 6.0
    world.place(START, SPEED)
    state = run(world, 1.0, command())
    assert state.position_m == pytest.approx(START + 10.0, abs=0.3)


def test_a_trailing_car_that_crashed_is_left_to_itself(world: CarlaWorld) -> None:
    crash(world, of=REAR)
    slower = [run(world, 0.5, command(rear=2.0)).speed_mps[REAR, 0] for _ in range(2)]
    assert slower[1] < slower[0] < 7.0


def driven(world: Any, schedule: Schedule, cars: Cars) -> Driven:
    return drive(world, cars, braking_plan(cars, 5, 0.8), schedule, record=True)


@pytest.mark.parametrize(("start_s", "outcome"), [(3.0, "none"), (6.75, "front")])
def test_the_operating_point_has_the_outcomes_of_the_other_simulators(
    world: CarlaWorld, start_s: float, outcome: str
) -> None:
    start = start_s + np.arange(5)[:, np.newaxis] * 0.8
    schedule = Schedule(start, np.full((5, 1), 0.8))
    found, exact = (driven(each, schedule, Cars()).outcomes for each in (world, Longitudinal()))
    assert (found.name(0), exact.name(0)) == (outcome, outcome)
    assert found.min_front_gap_m[0] == pytest.approx(exact.min_front_gap_m[0], abs=2.0)
    assert found.min_rear_gap_m[0] == pytest.approx(exact.min_rear_gap_m[0], abs=2.0)
    assert np.nan_to_num(found.front_impact_mps[0]) == pytest.approx(np.nan_to_num(exact.front_impact_mps[0]), abs=1.0)


@pytest.mark.parametrize("mode", ["computed", "closed-loop"])
def test_the_experiment_drives_it(mode: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "carla", fresh())
    found = s2a.ccrb(simulator="carla?port=2042", policy="stream-to-act", mode=mode, output=tmp_path)
    cell, *_ = found.json()["cells"]
    assert (cell["simulator"], cell["outcome"]) == ("carla", "none")
    assert found.manifest["configuration"]["simulator"] == "carla?port=2042"
    assert (SERVER.settings, SERVER.actors) == TOWN[1:]


FAILURES = {
    "get_world": "connecting",
    "generate_opendrive_world": "making the road",
    "spawn_actor lead": "making the cars",
    "spawn_actor rear": "making the cars",
    "spawn_actor bumper": "making the cars",
    "tick": "making the cars",
    "listen": "making the cars",
}


@pytest.mark.parametrize(("call", "doing"), FAILURES.items())
def test_a_server_that_fails_is_one_line_and_gets_its_settings_back(
    call: str, doing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "carla", fresh())
    SERVER.fails[call] = TIMED_OUT
    with pytest.raises(SimulatorError) as error:
        open_simulator("carla?host=sim&port=2042")
    assert str(error.value) == f"`simulator`: CARLA at sim:2042, {doing}: {TIMED_OUT}{LATER}"
    assert SERVER.settings == TOWN[1]
    # Until a step has shown a car, the client holds it for dead and does not destroy it.
    assert len(SERVER.actors) == (call == "tick")
    assert SERVER.timeout_s == 1.0
    assert (SERVER.map == TOWN[0]) == (call in {"get_world", "generate_opendrive_world"})


@pytest.mark.parametrize("gone", [("tick", "destroy", "get_world", "apply_settings"), ("tick",)])
def test_a_lost_step_is_the_error_and_what_can_be_restored_is(world: CarlaWorld, gone: tuple[str, ...]) -> None:
    world.place(START, SPEED)
    SERVER.fails |= dict.fromkeys(gone, TIMED_OUT)
    with pytest.raises(SimulatorError, match=r"a step: time-out of 60000ms"), closing(world):
        world.step(command())
    assert ((SERVER.settings, SERVER.actors) == TOWN[1:]) == (len(gone) == 1)


def test_settings_that_cannot_be_restored_are_told_and_the_cars_are_gone(world: CarlaWorld) -> None:
    SERVER.fails["apply_settings"] = TIMED_OUT
    with pytest.raises(SimulatorError, match=r"127.0.0.1:2000, restoring its settings: time-out"):
        world.close()
    assert SERVER.actors == []


def test_settings_come_back_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", fresh())
    SERVER.settings = (True, 0.05)
    with closing(CarlaWorld()):
        assert SERVER.settings == (True, 0.02)
        assert SERVER.map == OPENDRIVE
    assert SERVER.settings == (True, 0.05)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("carla?vehicle=vehicle.nobody.none", "making the cars: blueprint 'vehicle.nobody.none' not found"),
        (
            "carla?port=0",
            "carla: port = '0': input should be greater than or equal to 1; its parameters are host, port",
        ),
        ("carla?town=1", "carla: 'town' is not a parameter; its parameters are host, port, timeout_s, vehicle"),
    ],
)
def test_wrong_parameters_are_one_line(written: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", fresh())
    with pytest.raises(S2AError) as error:
        open_simulator(written)
    assert message in str(error.value)
    assert (SERVER.settings, SERVER.actors) == TOWN[1:]


def test_without_the_client_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(MissingExtra, match=r"the package carla is not installed; pip install '.\[carla\]'"):
        open_simulator("carla")


def test_a_car_that_leaves_the_road_ends_the_drive(world: CarlaWorld) -> None:
    with pytest.raises(SimulatorError, match=r"a car leaves the road of carla, 1500 m"):
        world.place(np.array([[40.0], [0.0], [-300.0]]), SPEED)


def test_a_camera_without_pictures_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", fresh())
    with closing(CarlaWorld(timeout_s=0.05)) as world:
        camera = world.camera(64, 48)
        SERVER.draws = False
        world.place(START, SPEED)
        with pytest.raises(SourceError, match="no picture of CARLA's last step"):
            camera.read()


def test_lane_changes_are_refused(world: CarlaWorld) -> None:
    plan = braking_plan(Cars(), 1, 0.8, lane_change=True)
    with pytest.raises(UsageError, match="'carla' has one lane only"):
        drive(world, Cars(), plan, Schedule(np.array([[1.0], [2.0]]), np.full((2, 1), 0.8)))
    world.place(START, SPEED)
    assert world.step(DriveCommand(np.zeros((3, 1)), np.array([1]))).lateral_m == pytest.approx(np.zeros((3, 1)))


def test_left_is_positive_though_carlas_y_points_right(world: CarlaWorld) -> None:
    world.place(START, SPEED)
    world._cars[EGO]._at[1] -= 1.5
    assert world.step(command()).lateral_m[:, 0] == pytest.approx([0.0, 1.5, 0.0])


def test_its_pictures_are_bgr_of_the_last_step(world: CarlaWorld) -> None:
    camera = world.camera(320, 240)
    world.place(START, SPEED)
    assert camera.read().data[0, 0].tolist() == [200, 150, 100]
    far = camera.read().data
    run(world, 2.0, command(lead=-8.0))
    assert (camera.read().data != far).any()


def test_the_ego_keeps_its_speed_against_what_slows_it(world: CarlaWorld) -> None:
    world.place(START, SPEED)
    assert run(world, 8.0, command()).speed_mps[EGO, 0] == pytest.approx(10.0, abs=0.03)
