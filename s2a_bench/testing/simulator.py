"""The conformance suite of simulators, and of their cameras."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from typing import ClassVar

import numpy as np
import pytest

from s2a_bench.frames import FrameSource
from s2a_bench.scenario import EGO, LANE_WIDTH_M, LEAD, REAR, SIMULATORS, DriveCommand, Simulator, State, open_simulator
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource

START = np.array([[40.0], [0.0], [-14.0]])
SPEED = np.full((3, 1), 10.0)


def command(lead: float = 0.0, ego: float = 0.0, rear: float = 0.0, lane: int = 0) -> DriveCommand:
    return DriveCommand(np.array([[lead], [ego], [rear]]), np.array([lane]))


def run(world: Simulator, seconds: float, wanted: DriveCommand) -> State:
    return [world.step(wanted) for _ in range(round(seconds / world.step_s))][-1]


class SimulatorSuite(FrameSourceSuite):
    """The simulator registered as ``name``, or what `open_world` opens; its cameras run the suite of frame sources."""

    name: ClassVar[str]
    before: ClassVar[object]
    PLACED, DRIVEN, RESTS, SEEN = 0.1, 0.1, 1e-6, 24
    """Tolerances in m and m/s: where cars are placed, after some seconds, at rest; of a pixel that shows the same."""

    test_its_kind_says_what_to_write_after_its_name = None  # type: ignore[assignment]  # a camera is not opened by name

    def open_world(self) -> Simulator:
        return open_simulator(self.name)

    @classmethod
    def outside(cls) -> object:
        """Return the state outside of itself that it may change, as settings of its server; here the environment."""
        return {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}

    @classmethod
    def setup_class(cls) -> None:
        dict(SIMULATORS.loaded())  # what a library changes when it is imported is not theirs to restore
        cls.before = cls.outside()

    @pytest.fixture
    def world(self) -> Iterator[Simulator]:
        with closing(self.open_world()) as world:
            yield world

    @pytest.fixture
    def make_source(self, world: Simulator) -> MakeSource:
        def make(width: int, height: int) -> FrameSource:
            camera = world.camera(width, height)
            world.place(START, SPEED)
            return camera

        return make

    def test_it_is_registered_under_its_name(self, world: Simulator) -> None:
        assert isinstance(world, SIMULATORS[world.name])
        assert world.step_s > 0
        assert {type(world.real), type(world.steers), type(world.over_ros)} == {bool}

    def test_cars_begin_where_they_are_placed_also_the_second_time(self, world: Simulator) -> None:
        for _ in range(2):
            state = world.place(START, SPEED)
            assert state.position_m == pytest.approx(START, abs=self.PLACED)
            assert state.speed_mps == pytest.approx(SPEED, abs=self.PLACED)
            assert state.lateral_m == pytest.approx(np.zeros((3, 1)), abs=self.PLACED)
            run(world, 1.0, command(lead=-3.0))

    def test_without_acceleration_speeds_and_gaps_stay(self, world: Simulator) -> None:
        world.place(START, SPEED)
        state = run(world, 2.0, command())
        assert state.speed_mps == pytest.approx(SPEED, abs=self.DRIVEN)
        assert state.position_m == pytest.approx(START + 20.0, abs=self.DRIVEN)
        assert np.diff(state.position_m, axis=0) == pytest.approx(np.diff(START, axis=0), abs=self.DRIVEN)

    def test_each_car_follows_its_own_acceleration(self, world: Simulator) -> None:
        world.place(START, SPEED)
        state = run(world, 2.0, command(lead=-2.0, ego=1.0, rear=-4.0))
        assert state.speed_mps[:, 0] == pytest.approx([6.0, 12.0, 2.0], abs=self.DRIVEN)
        assert state.position_m[:, 0] == pytest.approx([40.0 + 16.0, 22.0, -14.0 + 12.0], abs=self.DRIVEN)

    @pytest.mark.parametrize("decel_mps2", [2.0, 5.0])
    def test_a_car_stops_within_its_braking_distance_and_stays(self, world: Simulator, decel_mps2: float) -> None:
        at_m = [world.place(START, SPEED).position_m[EGO, 0]]
        for _ in range(round((10.0 / decel_mps2 + 1.5) / world.step_s)):
            state = world.step(command(ego=-decel_mps2, rear=-decel_mps2))  # bodies may be real
            at_m.append(state.position_m[EGO, 0])
        assert at_m[-1] == pytest.approx(10.0**2 / (2 * decel_mps2), abs=self.DRIVEN)
        assert np.diff(at_m).min() >= -self.RESTS
        assert at_m[-1] - at_m[-round(1.0 / world.step_s)] == pytest.approx(0.0, abs=self.RESTS)
        assert 0.0 <= state.speed_mps[EGO, 0] <= self.RESTS

    def test_a_car_at_rest_can_go_again(self, world: Simulator) -> None:
        world.place(START, np.zeros((3, 1)))
        assert run(world, 1.0, command(rear=1.0)).speed_mps[REAR, 0] == pytest.approx(1.0, abs=self.DRIVEN)

    def test_it_leaves_its_lane_if_it_says_that_it_steers(self, world: Simulator) -> None:
        world.place(START, SPEED)
        aside = run(world, 4.0, command(lane=1)).lateral_m
        assert aside[EGO, 0] == pytest.approx(LANE_WIDTH_M if world.steers else 0.0, abs=0.3)
        assert aside[[LEAD, REAR], 0] == pytest.approx([0.0, 0.0], abs=self.DRIVEN)

    def test_its_camera_shows_the_lead_growing_and_leaves_the_world_as_it_is(
        self, world: Simulator, make_source: MakeSource
    ) -> None:
        camera, pictures = make_source(320, 240), []
        for gap_m in (500.0, 40.0, 12.0):
            world.place(np.array([[gap_m], [0.0], [-14.0]]), SPEED)
            pictures.append(camera.read().data.astype(np.int64))
        far, near = (np.sum(np.abs(each - pictures[0]).max(axis=2) > self.SEEN) for each in pictures[1:])
        assert 0 < 2 * far < near
        camera.close()
        assert run(world, 1.0, command()).position_m[:, 0] == pytest.approx([22.0, 10.0, -4.0], abs=self.DRIVEN)

    def test_closing_restores_what_lies_outside(self, world: Simulator) -> None:
        world.place(START, SPEED)
        world.step(command())
        world.close()
        assert self.outside() == self.before
        world.close()
