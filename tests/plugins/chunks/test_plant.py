"""The plant against an integrator and textbook responses, one action at a time against all at once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from s2a_bench.act import ActionKind, kind
from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.plant import SUBSTEPS, Plant, PlantRobot

PERIOD_NS = 20_000_000
PERIOD_S = 0.02

numbers = st.floats(-3, 3, width=32)
plants = st.builds(Plant, st.floats(0.1, 20), st.floats(0, 3))


@st.composite
def sent(draw: st.DrawFn) -> list[np.ndarray | None]:
    """Actions of two joints, some of them stalls, the first not."""
    actions = draw(st.lists(st.none() | st.tuples(numbers, numbers), min_size=1, max_size=40))
    first = draw(st.tuples(numbers, numbers))
    return [None if action is None else np.array(action, np.float32) for action in (first, *actions)]


def as_array(actions: list[np.ndarray | None]) -> np.ndarray:
    return np.array([np.full(2, np.nan) if action is None else action for action in actions], np.float64)


@given(plants, sent())
def test_one_action_at_a_time_is_all_at_once(plant: Plant, actions: list[np.ndarray | None]) -> None:
    robot = plant.open_actions(2, PERIOD_NS)
    seen = []
    for tick, action in enumerate(actions):
        seen.append(robot.state())
        robot.send(action, tick * PERIOD_NS)
    motion = plant.respond(as_array(actions), PERIOD_S)
    np.testing.assert_allclose(np.array(seen[1:]), motion.position[1:, 0], atol=1e-9)
    moved = robot.moved(len(actions))
    mine, _ = moved
    np.testing.assert_array_equal(mine.position, motion.position)
    np.testing.assert_array_equal(mine.jerk, motion.jerk)


@given(plants, sent())
def test_the_response_is_that_of_an_integrator(plant: Plant, actions: list[np.ndarray | None]) -> None:
    motion = plant.respond(as_array(actions), PERIOD_S)
    rate, held, state = 2 * math.pi * plant.frequency_hz, 0.0, np.zeros(2)
    for tick, action in enumerate(actions):
        if action is not None:
            held = float(action[0])
        if tick == 0:
            state = np.array([held, 0.0])

        def slope(_: float, now: np.ndarray, to: float = held) -> list[float]:
            return [now[1], rate**2 * (to - now[0]) - 2 * plant.damping * rate * now[1]]

        times = np.arange(SUBSTEPS + 1) * PERIOD_S / SUBSTEPS
        found = solve_ivp(slope, (0, times[-1]), state, t_eval=times, rtol=1e-9, atol=1e-9).y
        np.testing.assert_allclose(motion.position[tick, :, 0], found[0, :-1], atol=1e-6)
        np.testing.assert_allclose(motion.velocity[tick, :, 0], found[1, :-1], atol=1e-4)
        state = found[:, -1]


def test_a_step_has_the_textbook_s_response() -> None:
    actions = np.array([[0.0]] + [[1.0]] * 60)
    motion = Plant(frequency_hz=2, damping=1).respond(actions, PERIOD_S)
    since = np.arange(60) * PERIOD_S * 4 * math.pi
    np.testing.assert_allclose(motion.position[1:, 0, 0], 1 - (1 + since) * np.exp(-since), atol=1e-9)
    assert motion.acceleration.max() == pytest.approx((4 * math.pi) ** 2)
    assert not motion.jerk[0].any()
    assert motion.jerk[1, 0, 0] == pytest.approx((4 * math.pi) ** 2 / PERIOD_S)
    overshoot = Plant(frequency_hz=2, damping=0.5).respond(actions, PERIOD_S).position.max()
    assert overshoot == pytest.approx(1 + math.exp(-math.pi / math.sqrt(3)), rel=1e-3)


def test_before_its_first_action_it_does_not_move() -> None:
    robot = PlantRobot(Plant(), 3, PERIOD_NS)
    robot.send(None, 0)
    assert robot.state() == (0, 0, 0)
    assert robot.moved(1) is None
    assert robot.actions.shape == (0, 3)
    with pytest.raises(ValueError, match="nothing to hold"):
        Plant().respond(np.array([[np.nan]]), PERIOD_S)


def test_it_is_opened_by_its_name_with_parameters_and_says_what_it_is() -> None:
    robot = kind("plant?frequency_hz=3&damping=.7", ActionKind).open_actions(2, PERIOD_NS)
    assert robot.describe() == {"robot": "plant", "frequency_hz": "3", "damping": "0.7"}
    robot.close()
    with pytest.raises(UsageError, match="`robot`: plant: an action of shape \\(3,\\) for 2 joints"):
        robot.send(np.zeros(3, np.float32), 0)


@pytest.mark.parametrize("written", ["plant?frequency_hz=0", "plant?damping=-1", "plant?stiffness=3", "arm"])
def test_what_is_no_plant_is_refused_by_the_field(written: str) -> None:
    with pytest.raises(UsageError, match="`robot`: "):
        kind(written, ActionKind)
