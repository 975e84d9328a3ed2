"""The ego's view: brake lights, the lane, the road that moves."""

from __future__ import annotations

import numpy as np
import pytest

from s2a_bench.scenario import SIMULATORS, State
from s2a_bench.scenario.windscreen import BODY, LAMP, LIT, PAINT, Windscreen
from s2a_bench.testing.simulator import SPEED, START, command, run
from s2a_bench.types import Pixels


def seen(
    gap_m: float = 12.0, ego_m: float = 0.0, aside_m: float = 0.0, lead_mps2: float = 0.0, width: int = 640
) -> Pixels:
    along, aside = np.array([[ego_m + gap_m], [ego_m], [ego_m - 14]]), np.array([[0.0], [aside_m], [0.0]])
    state, acceleration = State(along, np.full((3, 1), 10.0), aside), np.array([[lead_mps2], [0.0], [0.0]])
    return Windscreen(lambda: (state, acceleration), width, 480).read().data


def columns(picture: Pixels, colour: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    return np.unique(np.argwhere((picture == colour).all(axis=2))[:, 1])


@pytest.mark.parametrize(("lead_mps2", "shown", "other"), [(0.0, LAMP, LIT), (-0.5, LAMP, LIT), (-2.0, LIT, LAMP)])
def test_brake_lights_are_lit_while_the_lead_brakes(
    lead_mps2: float, shown: tuple[int, ...], other: tuple[int, ...]
) -> None:
    for gap_m in (12.0, 40.0):
        picture = seen(gap_m, lead_mps2=lead_mps2)
        assert columns(picture, shown).size
        assert not columns(picture, other).size


@pytest.mark.parametrize("gap_m", [6.0, 12.0, 40.0])
def test_the_lead_is_as_wide_as_its_distance_makes_it(gap_m: float) -> None:
    body = columns(seen(gap_m), BODY)
    focal = 320 / np.tan(np.radians(30))
    assert np.ptp(body) == pytest.approx(1.8 * focal / (gap_m + 1.5), abs=2.5)
    assert body.mean() == pytest.approx(320, abs=1)


def test_from_the_left_lane_the_lead_is_to_the_right() -> None:
    body = columns(seen(20.0, aside_m=4.0), BODY)
    assert body.mean() == pytest.approx(320 + 4 / 21.5 * 320 / np.tan(np.radians(30)), abs=2)


def test_the_marks_pass_by_as_the_ego_moves_and_come_again_after_their_period() -> None:
    first = seen(500.0)
    assert (seen(500.0, ego_m=3.0) != first).any(axis=2).mean() > 0.001
    np.testing.assert_array_equal(seen(500.0, ego_m=12.0), first)


@pytest.mark.parametrize("gap_m", [0.5, 0.0, -1.0, -3.0])
def test_a_car_that_touches_the_ego_fills_the_view(gap_m: float) -> None:
    assert (seen(gap_m) != seen(500.0)).any(axis=2).mean() > 0.3


def test_a_car_that_is_passed_is_no_longer_seen() -> None:
    assert (seen(-12.0) != seen(1e6)).any(axis=2).sum() < 5  # the other is a point at the horizon


def test_a_wide_and_a_narrow_picture_show_the_lead_in_the_middle() -> None:
    for width in (200, 1920):
        assert columns(seen(width=width), PAINT).size
        assert columns(seen(width=width), BODY).mean() == pytest.approx(width / 2, abs=1)


def test_a_camera_follows_the_first_roll_out_that_is_left() -> None:
    world = SIMULATORS["longitudinal"]()
    camera = world.camera(320, 240)
    world.place(np.hstack([START, [[10.0], [0.0], [-14.0]]]), np.hstack([SPEED, SPEED]))
    far = columns(camera.read().data, BODY).size
    world.keep(np.array([1]))  # type: ignore[attr-defined]
    assert columns(camera.read().data, BODY).size > 2 * far
    assert not columns(camera.read().data, LIT).size
    run(world, 0.1, command(lead=-3.0))
    assert columns(camera.read().data, LIT).size
