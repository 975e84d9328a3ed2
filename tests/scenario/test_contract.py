"""Every simulator keeps the contract."""

from __future__ import annotations

import numpy as np
import pytest

from s2a_bench.scenario import EGO, LEAD, REAR, SIMULATORS, DriveCommand, Simulator, State, simulator

START = np.array([[40.0], [0.0], [-14.0]])
SPEED = np.full((3, 1), 10.0)


def command(lead: float = 0.0, ego: float = 0.0, rear: float = 0.0, lane: int = 0) -> DriveCommand:
    return DriveCommand(np.array([[lead], [ego], [rear]]), np.array([lane]))


def run(world: Simulator, seconds: float, wanted: DriveCommand) -> State:
    state = world.step(wanted)
    for _ in range(round(seconds / world.step_s) - 1):
        state = world.step(wanted)
    return state


class SimulatorSuite:
    """What every simulator does; ``EXACT`` is how far it may be off, in m and m/s, after some seconds."""

    EXACT = 0.1

    def test_it_is_in_the_table_under_its_name(self, world: Simulator) -> None:
        assert world.name in SIMULATORS
        assert world.step_s > 0

    def test_cars_begin_where_they_are_placed(self, world: Simulator) -> None:
        state = world.place(START, SPEED)
        assert state.position_m.shape == state.speed_mps.shape == state.lateral_m.shape == (3, 1)
        assert state.position_m == pytest.approx(START, abs=self.EXACT)
        assert state.lateral_m == pytest.approx(np.zeros((3, 1)), abs=self.EXACT)

    def test_without_acceleration_the_speed_stays(self, world: Simulator) -> None:
        world.place(START, SPEED)
        state = run(world, 2.0, command())
        assert state.speed_mps == pytest.approx(SPEED, abs=self.EXACT)
        assert state.position_m == pytest.approx(START + 20.0, abs=self.EXACT)

    def test_each_car_follows_its_own_acceleration(self, world: Simulator) -> None:
        world.place(START, SPEED)
        state = run(world, 2.0, command(lead=-2.0, ego=1.0, rear=-4.0))
        assert state.speed_mps[:, 0] == pytest.approx([6.0, 12.0, 2.0], abs=self.EXACT)
        assert state.position_m[:, 0] == pytest.approx([40.0 + 16.0, 22.0, -14.0 + 12.0], abs=self.EXACT)

    def test_cars_brake_to_rest_and_never_backwards(self, world: Simulator) -> None:
        world.place(START, SPEED)
        stopped = run(world, 2.0, command(ego=-8.0))
        later = run(world, 1.0, command(ego=-8.0))
        assert later.speed_mps[EGO, 0] == pytest.approx(0.0, abs=1e-6)
        assert stopped.position_m[EGO, 0] == pytest.approx(100 / 16, abs=self.EXACT)
        assert later.position_m[EGO, 0] == pytest.approx(stopped.position_m[EGO, 0], abs=1e-6)

    def test_a_car_at_rest_can_go_again(self, world: Simulator) -> None:
        world.place(START, np.zeros((3, 1)))
        assert run(world, 1.0, command(rear=1.0)).speed_mps[REAR, 0] == pytest.approx(1.0, abs=self.EXACT)

    def test_placing_again_begins_anew(self, world: Simulator) -> None:
        world.place(START, SPEED)
        run(world, 1.0, command(lead=-3.0))
        state = world.place(START, SPEED)
        assert state.position_m == pytest.approx(START, abs=self.EXACT)
        assert state.speed_mps[LEAD, 0] == pytest.approx(10.0, abs=self.EXACT)

    def test_it_leaves_its_lane_if_it_says_that_it_steers(self, world: Simulator) -> None:
        world.place(START, SPEED)
        aside = run(world, 4.0, command(lane=1)).lateral_m if world.steers else np.array([[0.0], [4.0], [0.0]])
        assert aside[EGO, 0] == pytest.approx(4.0, abs=0.3)
        assert aside[[LEAD, REAR], 0] == pytest.approx([0.0, 0.0], abs=self.EXACT)


class TestLongitudinal(SimulatorSuite):
    EXACT = 1e-9

    @pytest.fixture
    def world(self) -> Simulator:
        return simulator("longitudinal")


class TestEmbedded(SimulatorSuite):
    @pytest.fixture
    def world(self) -> Simulator:
        return simulator("embedded")
