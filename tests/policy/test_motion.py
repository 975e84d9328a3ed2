"""Jerk and SPARC of speed profiles whose values are known."""

from __future__ import annotations

import numpy as np
import pytest

from s2a_bench.policy.motion import jerk, peak_jerk, rms_jerk, sparc, speed_profile


def minimum_jerk(duration_s: float, sample_s: float) -> np.ndarray:
    """Return the speed of the smoothest stroke over 1 m (Flash and Hogan 1985)."""
    x = np.arange(0, duration_s + sample_s / 2, sample_s) / duration_s
    return 30 * (x**2 - 2 * x**3 + x**4) / duration_s


def test_the_jerk_of_a_parabola_is_its_second_derivative() -> None:
    t = np.arange(0, 2, 0.01)
    assert jerk(3 * t**2, 0.01) == pytest.approx(np.full(len(t) - 2, 6.0), rel=1e-6)
    assert rms_jerk(3 * t**2, 0.01) == pytest.approx(6.0)
    assert peak_jerk(-3 * t**2, 0.01) == pytest.approx(6.0)


def test_steady_acceleration_has_no_jerk() -> None:
    assert peak_jerk(np.arange(0, 5, 0.5), 0.1) == 0.0


def test_the_jerk_of_a_minimum_jerk_stroke_is_the_textbooks() -> None:
    speed = minimum_jerk(2.0, 0.001)
    assert peak_jerk(speed, 0.001) == pytest.approx(60 / 2.0**3, rel=0.01)
    assert rms_jerk(speed, 0.001) == pytest.approx(np.sqrt(720) / 2.0**3, rel=0.01)


def test_a_profile_of_two_samples_has_no_jerk() -> None:
    with pytest.raises(ValueError, match="3 samples"):
        rms_jerk(np.array([0.0, 1.0]), 0.1)


def test_sparc_is_that_of_its_authors_on_their_example() -> None:
    t = np.arange(-1, 1, 0.01)
    assert sparc(np.exp(-5 * t**2), 0.01) == pytest.approx(-1.41403, abs=5e-6)


def test_sparc_does_not_depend_on_how_far_the_motion_goes() -> None:
    speed = minimum_jerk(1.0, 0.01)
    assert sparc(7 * speed, 0.01) == pytest.approx(sparc(speed, 0.01))


def test_a_stop_halfway_is_less_smooth_by_every_measure() -> None:
    once = minimum_jerk(4.0, 0.01)
    half = minimum_jerk(1.5, 0.01) / 2
    halting = np.concatenate([half, np.zeros(100), half])
    assert sparc(halting, 0.01) < sparc(once, 0.01) - 0.1
    assert rms_jerk(halting, 0.01) > rms_jerk(once, 0.01)
    assert peak_jerk(halting, 0.01) > peak_jerk(once, 0.01)


@pytest.mark.parametrize("speed", [[], [0.0, 0.0, 0.0]])
def test_what_never_moves_has_no_smoothness(speed: list[float]) -> None:
    with pytest.raises(ValueError, match="without speed"):
        sparc(np.array(speed), 0.01)


def test_a_timeline_without_stalls_speeds_up_once_and_slows_down_once() -> None:
    ones = np.ones(3)
    speed = speed_profile(np.array([2.0, 3.0, 4.0]), ones, ones, 0.01, ramp_s=0.2)
    assert speed.max() == pytest.approx(1.0)
    assert speed[[0, -1]].tolist() == [0.0, 0.0]
    assert speed.sum() * 0.01 == pytest.approx(3.0)  # the way that was planned
    assert (np.diff(speed[:150]) >= -1e-12).all()
    assert peak_jerk(speed, 0.01) == pytest.approx(1 / 0.2**2)
    assert np.abs(np.diff(speed)).max() / 0.01 == pytest.approx(1 / 0.2)


def test_a_robot_is_at_full_speed_after_six_tenths_of_a_second_unless_told_otherwise() -> None:
    speed = speed_profile(np.array([0.0]), np.array([3.0]), np.array([3.0]), 0.01)
    assert np.argmax(speed > 1 - 1e-9) * 0.01 == pytest.approx(0.6, abs=0.02)
    assert peak_jerk(speed, 0.01) == pytest.approx(1 / 0.3**2)


def test_a_robot_that_follows_within_a_sample_moves_as_its_skills_say() -> None:
    speed = speed_profile(np.array([0.0, 2.0]), np.array([1.0, 1.0]), np.ones(2), 0.5, ramp_s=0.1)
    assert speed[speed.nonzero()[0][0] :].tolist() == pytest.approx([1, 1, 0, 0, 1, 1, 0])


def test_a_stall_stops_the_robot_and_a_stretched_skill_slows_it() -> None:
    nominal_s = np.ones(3)
    stalled = speed_profile(np.array([0.0, 3.0, 4.0]), nominal_s, nominal_s, 0.01, ramp_s=0.2)
    stretched = speed_profile(np.array([0.0, 2.0, 4.0]), np.array([2.0, 2.0, 1.0]), nominal_s, 0.01, ramp_s=0.2)
    assert stalled[200] == pytest.approx(0.0, abs=1e-12)
    assert stretched[200] == pytest.approx(0.5)
    assert stalled.sum() == pytest.approx(stretched.sum())
    assert rms_jerk(stalled, 0.01) > rms_jerk(stretched, 0.01)
    assert sparc(stalled, 0.01) < sparc(stretched, 0.01)


def test_edges_between_two_samples_keep_the_way() -> None:
    start_s, duration_s = np.array([0.123, 1.789]), np.array([1.0, 0.777])
    speed = speed_profile(start_s, duration_s, np.array([1.3, 0.5]), 0.01)
    assert speed.sum() * 0.01 == pytest.approx(1.8)
