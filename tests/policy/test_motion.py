"""Jerk and SPARC of speed profiles whose values are known."""

from __future__ import annotations

import cmath
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.policy.metrics import jerk, motion, sparc, speed_profile


def minimum_jerk(duration_s: float, sample_s: float) -> np.ndarray:
    """Return the speed of the smoothest stroke over 1 m (Flash and Hogan 1985)."""
    x = np.arange(0, duration_s + sample_s / 2, sample_s) / duration_s
    return 30 * (x**2 - 2 * x**3 + x**4) / duration_s


def test_the_jerk_of_a_parabola_is_its_second_derivative() -> None:
    t = np.arange(0, 2, 0.01)
    assert jerk(3 * t**2, 0.01) == pytest.approx(np.full(len(t) - 2, 6.0), rel=1e-6)
    with pytest.raises(ValueError, match="3 samples"):
        jerk(np.array([0.0, 1.0]), 0.1)


def test_the_jerk_of_a_minimum_jerk_stroke_is_the_textbooks() -> None:
    for stroke in (minimum_jerk(2.0, 0.001), -minimum_jerk(2.0, 0.001)):
        values = motion(stroke, 0.001)
        assert values["peak_jerk"] == pytest.approx(60 / 2.0**3, rel=0.01)
        assert values["rms_jerk"] == pytest.approx(np.sqrt(720) / 2.0**3, rel=0.01)


def test_sparc_is_that_of_its_authors_on_their_example() -> None:
    t = np.arange(-1, 1, 0.01)
    assert sparc(np.exp(-5 * t**2), 0.01) == pytest.approx(-1.41403, abs=5e-6)


def arc_length(speed: list[float], sample_s: float, padding: int, cutoff_hz: float, threshold: float) -> float:
    """Follow the words of the definition, with the sum that a Fourier transform is."""
    size = 2 ** (math.ceil(math.log2(len(speed))) + padding)
    turn = -2j * math.pi / size
    amplitude = [abs(sum(v * cmath.exp(turn * k * i) for i, v in enumerate(speed))) for k in range(size // 2 + 1)]
    curve = [(k / (size * sample_s), one / max(amplitude)) for k, one in enumerate(amplitude)]
    last = max(k for k, (hz, one) in enumerate(curve) if hz <= cutoff_hz and one >= threshold)
    first = min(k for k, (_, one) in enumerate(curve) if one >= threshold)
    band = curve[first : last + 1]
    width_hz = band[-1][0] - band[0][0]
    return -sum(math.hypot((hz2 - hz1) / width_hz, two - one) for (hz1, one), (hz2, two) in pairwise(band))


@given(
    speed=st.lists(st.floats(0.1, 2.0), min_size=3, max_size=20),
    cutoff_hz=st.sampled_from([1.0, 2.5, 6.0]),
    threshold=st.sampled_from([0.02, 0.05, 0.2]),
    padding=st.integers(1, 3),
)
def test_sparc_is_the_length_of_the_spectrum_s_curve_up_to_the_cutoff(
    speed: list[float], cutoff_hz: float, threshold: float, padding: int
) -> None:
    found = sparc(np.array(speed), 0.05, padding=padding, cutoff_hz=cutoff_hz, threshold=threshold)
    assert found == pytest.approx(arc_length(speed, 0.05, padding, cutoff_hz, threshold))


@pytest.mark.parametrize("speed", [[], [0.0, 0.0, 0.0]])
def test_what_never_moves_has_no_smoothness(speed: list[float]) -> None:
    with pytest.raises(ValueError, match="without speed"):
        sparc(np.array(speed), 0.01)


def test_a_timeline_without_stalls_speeds_up_once_and_slows_down_once() -> None:
    ones = np.ones(3)
    speed = speed_profile(np.array([2.0, 3.0, 4.0]), ones, ones, 0.01)
    assert speed.max() == pytest.approx(1.0)
    assert speed[[0, -1]].tolist() == [0.0, 0.0]
    assert speed.sum() * 0.01 == pytest.approx(3.0)  # the way that was planned
    assert (np.diff(speed[:150]) >= -1e-12).all()
    assert np.argmax(speed > 1 - 1e-9) * 0.01 == pytest.approx(0.6, abs=0.02)
    assert motion(speed, 0.01)["peak_jerk"] == pytest.approx(1 / 0.3**2)
    assert np.abs(np.diff(speed)).max() / 0.01 == pytest.approx(1 / 0.3)


def test_a_stall_stops_the_robot_and_a_stretched_skill_slows_it() -> None:
    nominal_s = np.ones(3)
    stalled = speed_profile(np.array([0.0, 3.0, 4.0]), nominal_s, nominal_s, 0.01)
    stretched = speed_profile(np.array([0.0, 2.0, 4.0]), np.array([2.0, 2.0, 1.0]), nominal_s, 0.01)
    assert stalled[230] == pytest.approx(0.0, abs=1e-12)
    assert stretched[230] == pytest.approx(0.5)
    assert stalled.sum() == pytest.approx(stretched.sum())
    jerky, smooth = motion(stalled, 0.01), motion(stretched, 0.01)
    assert jerky["rms_jerk"] > smooth["rms_jerk"]
    assert jerky["sparc"] < smooth["sparc"]


def test_edges_between_two_samples_keep_the_way() -> None:
    start_s, duration_s = np.array([0.123, 1.789]), np.array([1.0, 0.777])
    speed = speed_profile(start_s, duration_s, np.array([1.3, 0.5]), 0.01)
    assert speed.sum() * 0.01 == pytest.approx(1.8)
