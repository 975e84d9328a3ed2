"""What a robot sends, in words."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from s2a_bench.plugins.watch.shapes import described

NOISE = np.random.default_rng(0).integers(0, 255, (3, 32, 48, 3), np.uint8)


def file_of(kind: str) -> bytes:
    return cv2.imencode(kind, NOISE[0])[1].tobytes()


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"image": NOISE, "state": np.zeros(8), "prompt": "go"}, "3 pictures 48x32 uint8, 8 numbers, 1 text; as JPEG"),
        ({"a": {"b": [NOISE[0] / 255.0]}}, "1 picture 48x32 float64; as JPEG"),
        ([np.moveaxis(NOISE / 127.5 - 1, -1, -3).astype(np.float32)], "3 pictures 48x32 float32; as JPEG"),
        ({"image": file_of(".jpg")}, "1 JPEG 48x32"),
        ({"url": "data:image/png;base64," + base64.b64encode(file_of(".png")).decode()}, "1 PNG 48x32; as JPEG"),
        ({"image": base64.b64encode(file_of(".jpg")).decode()}, "1 JPEG 48x32"),
        ({"state": [1, 2.5], "on": True, "none": None}, "2 numbers"),
        ({"mask": np.zeros((4, 4, 3)), "raw": b"12345"}, "48 numbers, 5 bytes"),
        ({"image": b"\xff\xd8\xff damaged"}, "11 bytes"),
        ({}, ""),
    ],
)
def test_a_request_in_words(request_: object, words: str) -> None:
    assert re.sub(" about .*", "", described(request_)) == words


def test_the_size_as_jpeg_is_that_of_all_pictures() -> None:
    one, three = (int(re.findall(r"about (\d+) kB", described(each))[0]) for each in (NOISE[:1], NOISE))
    assert 2 * one <= three <= 4 * one


def test_a_picture_that_is_not_finite_is_one() -> None:
    assert described(np.full((32, 32, 3), np.nan)).startswith("1 picture 32x32 float64")
