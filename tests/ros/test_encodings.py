"""Every encoding that a robot's camera sends becomes the RGB that OpenCV makes of it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from s2a_bench.errors import TransportError
from s2a_bench.ros import messages as ros
from s2a_bench.trace import Trace
from s2a_bench.transport.ros.camera import picture_of
from s2a_bench.types import Frame

WIDTH, HEIGHT = 24, 16
SHAPES: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("bgr8", "rgb8"), (HEIGHT, WIDTH, 3)),
    **dict.fromkeys(("bgra8", "rgba8"), (HEIGHT, WIDTH, 4)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuv422", "uyvy", "mono16"), (HEIGHT, WIDTH, 2)),
    **dict.fromkeys(("mono8", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), (HEIGHT, WIDTH)),
    **dict.fromkeys(("nv12", "nv21"), (HEIGHT * 3 // 2, WIDTH)),
}
CODES: dict[str, int | None] = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgb8": None,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUYV,
    "yuyv": cv2.COLOR_YUV2RGB_YUYV,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "nv12": cv2.COLOR_YUV2RGB_NV12,
    "nv21": cv2.COLOR_YUV2RGB_NV21,
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB,  # OpenCV's old names are those of the second row
    "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}
BAYER = ("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8")


def pixels(encoding: str, seed: int = 1) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, SHAPES[encoding], np.uint8)


def image(encoding: str, data: NDArray[np.uint8], padding: int = 0, **fields: Any) -> Any:
    """A message whose rows are padded."""
    message = ros.image_message(Frame(0, 0, 2, 2, "rgb8", np.zeros((2, 2, 3), np.uint8)), 5, "c")
    rows = np.full((data.shape[0], data[0].size + padding), 170, np.uint8)
    rows[:, : data[0].size] = data.reshape(data.shape[0], -1)
    message.width, message.height, message.encoding = WIDTH, HEIGHT, encoding
    message.step, message.data = rows.shape[1], rows.reshape(-1)
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def rgb(encoding: str, data: NDArray[np.uint8], padding: int = 0, **fields: Any) -> NDArray[np.uint8]:
    frame = picture_of(image(encoding, data, padding, **fields), Trace())
    assert (frame.encoding, frame.width, frame.height, frame.stamp_ns) == ("rgb8", WIDTH, HEIGHT, 5)
    return frame.data


@pytest.mark.parametrize("padding", [0, 3, 8])
@pytest.mark.parametrize("encoding", CODES)
def test_rgb_is_what_opencv_makes_of_it(encoding: str, padding: int) -> None:
    data = pixels(encoding)
    code = CODES[encoding]
    expected = data if code is None else cv2.cvtColor(data, code)
    np.testing.assert_array_equal(rgb(encoding, data, padding), expected)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("encoding", "channels", "step"), [("mono16", 1, 170), ("rgb16", 3, 50), ("bgr16", 3, 50)])
def test_16_bits_are_scaled_to_8_as_cv_bridge_does(encoding: str, channels: int, step: int, big: bool) -> None:
    values = np.arange(HEIGHT * WIDTH * channels, dtype=np.uint16).reshape(HEIGHT, WIDTH, channels) * step
    data = np.ascontiguousarray(values.astype(">u2" if big else "<u2")).view(np.uint8)
    expected = np.rint(values * (255 / 65535)).astype(np.uint8).repeat(3 // channels, axis=2)
    for padding in (0, 3):
        got = rgb(encoding, data, padding, is_bigendian=int(big))
        np.testing.assert_array_equal(got, expected[..., ::-1] if encoding == "bgr16" else expected)


@pytest.mark.parametrize(("opencv", "named"), [("8UC3", "bgr8"), ("8UC1", "mono8")])
def test_a_picture_under_the_name_of_its_opencv_type_is_in_opencvs_order(opencv: str, named: str) -> None:
    data = pixels(named)
    np.testing.assert_array_equal(rgb(opencv, data), rgb(named, data))


@pytest.mark.parametrize("encoding", BAYER)
def test_a_mosaic_of_one_colour_is_that_colour(encoding: str) -> None:
    colour = {"r": 200, "g": 120, "b": 40}
    tile = np.array([colour[letter] for letter in encoding[6:10]], np.uint8).reshape(2, 2)
    got = rgb(encoding, np.tile(tile, (HEIGHT // 2, WIDTH // 2)))
    assert (got == np.array([200, 120, 40])).all()


@pytest.mark.parametrize(
    ("encoding", "fields"),
    [
        ("nv12", {"step": WIDTH + 1}),
        ("yuv422", {"width": 3}),
        ("bayer_rggb8", {"height": HEIGHT + 1}),
        ("bgr8", {"width": 0}),
        ("bgr8", {"step": 0}),
        ("bgr8", dict.fromkeys(("width", "height", "step"), 2**32 - 1)),
        ("bgr8", {"width": 50_000_001, "height": 1, "step": 150_000_003}),
        ("rgb16", {}),
        ("", {}),
    ],
)
def test_what_does_not_fit_its_encoding_is_refused(encoding: str, fields: dict[str, Any]) -> None:
    says = None if encoding else "image encoding '' is not one of bgr8, rgb8, bgra8"
    with pytest.raises(TransportError, match=says):
        picture_of(image(encoding, pixels(encoding if encoding in SHAPES else "bgra8"), **fields), Trace())


def compressed(data: NDArray[np.uint8], kind: str, format_: str) -> Any:
    """A message as compressed_image_transport writes it, of what OpenCV is given."""
    done, coded = cv2.imencode(f".{kind}", data)
    assert done
    message = ros.compressed_image_message(coded, 5, "c")
    message.format = format_
    return message


@pytest.mark.parametrize("kind", ["jpeg", "png"])
@pytest.mark.parametrize(
    "format_", ["{}", "bgr8; {} compressed bgr8", "rgb8; {} compressed bgr8", "rgba8; {} compressed bgr8", "bgr8; {}"]
)
def test_a_compressed_picture_has_its_colours(kind: str, format_: str) -> None:
    bgr = np.full((HEIGHT, WIDTH, 3), (40, 120, 200), np.uint8)
    got = picture_of(compressed(bgr, kind, format_.format(kind)), Trace())
    assert (got.stamp_ns, got.width, got.height) == (5, WIDTH, HEIGHT)
    assert np.abs(got.data.astype(int) - (200, 120, 40)).max() <= 2


@pytest.mark.parametrize("format_", ["rgb8; png compressed ", "rgb8; png compressed rgb8", "bgr8; png compressed "])
def test_where_bgr8_is_not_said_red_and_blue_changed_places(format_: str) -> None:
    """As compressed_image_transport's subscriber takes it."""
    rgb = np.full((HEIGHT, WIDTH, 3), (200, 120, 40), np.uint8)
    got = picture_of(compressed(rgb, "png", format_), Trace())
    assert (got.data == (200, 120, 40)).all()


@pytest.mark.parametrize("encoding", BAYER)
def test_a_mosaic_that_was_compressed_as_grey_gets_its_colours(encoding: str) -> None:
    mosaic = pixels(encoding)
    trace = Trace()
    got = picture_of(compressed(mosaic, "png", f"{encoding}; png compressed "), trace)
    np.testing.assert_array_equal(got.data, rgb(encoding, mosaic))
    assert {stage for stage, _ in trace.marks} == {"image_decode"}


def test_grey_that_was_compressed_is_grey() -> None:
    grey = pixels("mono8")
    for format_ in ("mono8; png compressed ", "mono8; png compressed mono8", "png"):
        got = picture_of(compressed(grey, "png", format_), Trace())
        np.testing.assert_array_equal(got.data, grey[..., None].repeat(3, axis=2))


@pytest.mark.parametrize("format_", ["16UC1; compressedDepth", "32FC1; compressedDepth png", "16UC1; png compressed "])
def test_compressed_depth_is_refused(format_: str) -> None:
    with pytest.raises(TransportError, match="is depth"):
        picture_of(compressed(pixels("mono8"), "png", format_), Trace())


@pytest.mark.parametrize("format_", ["bayer_rggb16; png compressed ", "bgr8; tiff compressed bgr8", "bgr8; qoi"])
def test_other_compressed_pictures_are_refused(format_: str) -> None:
    message = compressed(pixels("mono8"), "tiff" if "bayer" not in format_ else "png", format_)
    with pytest.raises(TransportError):
        picture_of(message, Trace())
