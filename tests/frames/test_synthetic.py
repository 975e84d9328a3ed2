"""The synthetic camera: deterministic, always moving, and as heavy as a natural picture."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from s2a_bench.errors import UsageError
from s2a_bench.frames.convert import encode_jpeg, to_bgr
from s2a_bench.frames.synthetic import SyntheticCamera
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource
from s2a_bench.types import Frame


class TestContract(FrameSourceSuite):
    @pytest.fixture
    def make_source(self) -> MakeSource:
        return lambda width, height: SyntheticCamera("", width, height)


def frames(count: int, width: int = 64, height: int = 48, *, step: int = 1, seed: int = 0) -> list[Frame]:
    """Every ``step``-th frame of a new camera."""
    camera = SyntheticCamera("", width, height, seed=seed)
    return [camera.read() for _ in range(count * step)][::step]


def power_slope(luma: NDArray[np.uint8]) -> float:
    """Fit the exponent of power over spatial frequency, all directions, from 4 cycles a side to half of Nyquist."""
    side = min(luma.shape)
    square = luma[:side, :side] - luma[:side, :side].mean()
    window = np.hanning(side)
    power = np.abs(np.fft.fft2(square * window * window[:, None])) ** 2
    cycles = np.fft.fftfreq(side, 1 / side)
    radius = np.hypot(cycles, cycles[:, None]).astype(int).ravel()
    mean = np.bincount(radius, power.ravel()) / np.bincount(radius)
    band = np.arange(4, side // 4)
    return float(np.polyfit(np.log(band), np.log(mean[band]), 1)[0])


def test_the_scene_moves_and_another_seed_gives_another() -> None:
    one, other = (frames(1, seed=seed)[0].data for seed in (3, 4))
    assert np.mean(one != other) > 0.9
    first, _, later = (frame.data for frame in frames(3, step=5))
    assert np.mean(first != later) > 0.5


@pytest.mark.parametrize("seed", range(2))
def test_a_vga_jpeg_weighs_what_a_photograph_does(seed: int) -> None:
    for frame in frames(4, 640, 480, step=40, seed=seed):
        assert 40_000 < encode_jpeg(to_bgr(frame)).nbytes < 150_000


@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080)])
def test_larger_jpegs_weigh_as_much_per_pixel_or_somewhat_less(size: tuple[int, int]) -> None:
    [frame] = frames(1, *size)
    bits_per_pixel = encode_jpeg(to_bgr(frame)).nbytes * 8 / (size[0] * size[1])
    assert 1.0 < bits_per_pixel < 3.9


@pytest.mark.parametrize("seed", range(2))
def test_power_falls_with_frequency_as_in_natural_pictures(seed: int) -> None:
    [frame] = frames(1, 640, 480, seed=seed)
    assert -3.0 < power_slope(frame.data[..., 0]) < -1.2


def test_contrast_is_neither_flat_nor_clipped() -> None:
    for seed in range(2):
        luma, chroma = np.moveaxis(frames(1, 640, 480, seed=seed)[0].data, -1, 0)
        assert 20 < luma.std() < 70
        assert np.mean((luma <= 16) | (luma >= 235)) < 0.05
        assert 3 < chroma.std() < 30


def test_chroma_lies_in_pairs_of_u_and_v() -> None:
    [frame] = frames(1, 640, 480)
    u, v = frame.data[:, 0::2, 1].astype(int), frame.data[:, 1::2, 1].astype(int)
    # neighbours of one kind are alike; U and V are not
    assert np.abs(np.diff(u, axis=1)).mean() < 2
    assert np.abs(u - v).mean() > 5


def test_odd_and_tiny_sizes_and_rates_that_are_none_are_refused() -> None:
    for size in ((641, 480), (14, 16), (16, 15)):
        with pytest.raises(UsageError, match=f"`size`: {size[0]}x{size[1]} should"):
            SyntheticCamera("", *size)
    for fps in (0.0, -1.0, float("nan")):
        with pytest.raises(UsageError, match="`fps`"):
            SyntheticCamera("", 64, 48, fps=fps)


@pytest.mark.parametrize("size", [(16, 16), (18, 200), (400, 17)])
def test_small_and_long_sizes_work(size: tuple[int, int]) -> None:
    assert len({frame.data.tobytes() for frame in frames(5, *size, step=20)}) > 1
