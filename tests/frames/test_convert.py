"""Colour conversion against BT.601 written out."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from s2a_bench.frames.convert import (
    bgr_to_rgb,
    decode_image,
    decode_received,
    encode_jpeg,
    encode_png,
    resize,
    to_bgr,
    yuyv_to_rgb,
)
from s2a_bench.types import Encoding, Frame
from tests.hostile.wires.http import png_of_zeros

Array = NDArray[np.uint8]


def pictures(channels: int, *, even: bool = False) -> st.SearchStrategy[Array]:
    """Any small picture."""
    width = st.integers(1, 35).map(lambda half: half * 2) if even else st.integers(1, 70)
    shapes = st.tuples(st.integers(1, 5), width, st.just(channels))
    return shapes.flatmap(lambda shape: npst.arrays(np.uint8, shape))


def _noise(*shape: int) -> Array:
    return np.random.default_rng(1).integers(0, 256, shape, np.uint8)


def planes(yuyv: Array) -> tuple[NDArray[np.int64], ...]:
    """Return Y - 16, and each pixel's U - 128 and V - 128."""
    wide = yuyv.astype(np.int64)
    return wide[..., 0] - 16, wide[:, 0::2, 1].repeat(2, axis=1) - 128, wide[:, 1::2, 1].repeat(2, axis=1) - 128


def bt601_fixed_point(yuyv: Array) -> Array:
    """BT.601 limited range in 20-bit fixed point, black below Y = 16: what OpenCV documents in its source."""
    y, u, v = planes(yuyv)
    y = np.maximum(y, 0) * 1220542
    rgb = (y + 1673527 * v, y - 852492 * v - 409993 * u, y + 2116026 * u)
    return np.stack([((channel + (1 << 19)) >> 20).clip(0, 255) for channel in rgb], axis=-1).astype(np.uint8)


def yuyv_frame(yuyv: Array) -> Frame:
    return Frame(0, 0, yuyv.shape[1], yuyv.shape[0], "yuv422_yuy2", yuyv)


@given(pictures(2, even=True))
def test_yuyv_is_bt601_in_fixed_point_exactly(yuyv: Array) -> None:
    np.testing.assert_array_equal(yuyv_to_rgb(yuyv), bt601_fixed_point(yuyv))
    np.testing.assert_array_equal(to_bgr(yuyv_frame(yuyv)), bt601_fixed_point(yuyv)[..., ::-1])


def test_a_given_buffer_is_filled_and_returned() -> None:
    yuyv = _noise(8, 10, 2)
    out = np.zeros((8, 10, 3), np.uint8)
    assert yuyv_to_rgb(yuyv, out) is out
    np.testing.assert_array_equal(out, yuyv_to_rgb(yuyv))
    swapped = np.zeros_like(out)
    assert bgr_to_rgb(out, swapped) is swapped
    np.testing.assert_array_equal(swapped, out[..., ::-1])


def test_read_only_pixels_and_windows_convert_as_well() -> None:
    yuyv = _noise(20, 40, 2)
    received = np.frombuffer(yuyv.tobytes(), np.uint8).reshape(yuyv.shape)
    assert not received.flags.writeable
    np.testing.assert_array_equal(yuyv_to_rgb(received), yuyv_to_rgb(yuyv))
    np.testing.assert_array_equal(yuyv_to_rgb(yuyv[3:9, 4:20]), yuyv_to_rgb(yuyv)[3:9, 4:20])


@pytest.mark.parametrize("shape", [(4, 4, 3), (4, 4), (4, 5, 2)])
def test_pixels_that_are_no_yuyv_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"\(h, w, 2\)|width cannot be 5"):
        yuyv_to_rgb(np.zeros(shape, np.uint8))


def test_a_buffer_that_does_not_fit_is_refused_and_not_passed_over() -> None:
    with pytest.raises(ValueError, match=r"out should be uint8 of shape \(4, 4, 3\)"):
        yuyv_to_rgb(np.zeros((4, 4, 2), np.uint8), np.zeros((4, 6, 3), np.uint8))


def test_jpeg_keeps_colours_and_their_order() -> None:
    bgr = np.full((32, 48, 3), (200, 120, 40), np.uint8)
    assert np.abs(decode_image(encode_jpeg(bgr)).astype(int) - (40, 120, 200)).max() <= 2


@pytest.mark.parametrize("data", [b"", b"x", b"\xff\xd8\xff\xe0" + bytes(60), bytes(1000)])
def test_garbage_is_no_picture(data: bytes) -> None:
    with pytest.raises(ValueError, match=f"the {len(data)} bytes are not a picture"):
        decode_image(data)


@pytest.mark.parametrize(
    ("encoding", "make"),
    [
        ("bgr8", lambda bgr: bgr),
        ("rgb8", bgr_to_rgb),
        ("png", encode_png),
    ],
)
def test_to_bgr_undoes_every_lossless_encoding(encoding: Encoding, make: object) -> None:
    bgr = _noise(6, 8, 3)
    assert callable(make)
    np.testing.assert_array_equal(to_bgr(Frame(0, 0, 8, 6, encoding, make(bgr))), bgr)


def test_to_bgr_converts_cameras_grey_and_jpeg() -> None:
    yuyv, grey = _noise(6, 8, 2), _noise(6, 8)
    np.testing.assert_array_equal(to_bgr(yuyv_frame(yuyv)), yuyv_to_rgb(yuyv)[..., ::-1])
    np.testing.assert_array_equal(to_bgr(Frame(0, 0, 8, 6, "mono8", grey)), grey[..., None].repeat(3, axis=2))
    jpeg = encode_jpeg(yuyv_to_rgb(yuyv))
    np.testing.assert_array_equal(to_bgr(Frame(0, 0, 8, 6, "jpeg", jpeg)), bgr_to_rgb(decode_image(jpeg)))


def test_resizing_averages_and_leaves_a_fitting_picture_alone() -> None:
    bgr = np.zeros((4, 8, 3), np.uint8)
    bgr[:, 4:] = 200
    assert resize(bgr, 8, 4) is bgr
    assert resize(bgr, 2, 1).tolist() == [[[0, 0, 0], [200, 200, 200]]]


def jpeg_of(width: int, height: int) -> bytes:
    """Return a JPEG of 8x8 pixels whose header says that it has this size."""
    data = bytearray(encode_jpeg(_noise(8, 8, 3)))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


DECODES = """
import sys
from collections.abc import Callable
from pathlib import Path
{first}
from s2a_bench.frames.convert import decode_received
def peak_kib():
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
data, before = Path(sys.argv[1]).read_bytes(), peak_kib()
try:
    decode_received(data)
except ValueError as error:
    print(peak_kib() - before, error)
"""
TUNED = "from s2a_bench.machine import tuning\nwith tuning.allowed(): tuning.limit_threads()"


@pytest.mark.parametrize("first", ["", TUNED], ids=["plain", "tuned"])
@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (png_of_zeros(100_000, 501), ": pixels <= CV_IO_MAX_IMAGE_PIXELS"),
        (jpeg_of(7072, 7071), ": pixels <= CV_IO_MAX_IMAGE_PIXELS"),
        (jpeg_of(65_535, 65_535), ""),  # more than libjpeg decodes
    ],
    ids=["png", "jpeg", "largest"],
)
def test_a_bomb_is_refused_by_its_header(tmp_path: Path, first: str, data: bytes, reason: str) -> None:
    (tmp_path / "bomb").write_bytes(data)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV_")}
    command = [sys.executable, "-c", DECODES.format(first=first), str(tmp_path / "bomb")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    kib, said = done.stdout.split(" ", 1)
    assert said == f"the {len(data)} bytes are not a picture that OpenCV can read{reason}\n"
    assert int(kib) < 20 << 10


@pytest.mark.parametrize("suffix", [".bmp", ".tiff", ".webp", ".ppm"])
def test_only_jpeg_and_png_are_taken_from_outside(suffix: str) -> None:
    picture = _noise(8, 8, 3)
    data = cv2.imencode(suffix, picture)[1]
    assert decode_image(data).shape == picture.shape
    with pytest.raises(ValueError, match="neither a JPEG nor a PNG"):
        decode_received(data)


@pytest.mark.parametrize("make", [encode_png, encode_jpeg])
def test_jpeg_and_png_are_decoded_from_any_buffer(make: Callable[[Array], Array]) -> None:
    data = make(_noise(6, 8, 3))
    for received in (data, data.tobytes(), memoryview(data)):
        np.testing.assert_array_equal(decode_received(received), decode_image(data))
