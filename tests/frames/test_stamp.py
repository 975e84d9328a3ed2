"""The stamp: no two frames of any source are alike, within a run and across runs, unless the nonce is the same."""

from __future__ import annotations

from dataclasses import replace
from secrets import token_hex

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from s2a_bench.clock import now_ns
from s2a_bench.frames import FrameSource
from s2a_bench.frames.convert import bgr_to_rgb, decode_image, encode_jpeg, to_bgr
from s2a_bench.frames.stamp import SIDE, Stamped
from s2a_bench.frames.synthetic import SyntheticCamera
from s2a_bench.types import Encoding, Frame

SHAPES: dict[Encoding, tuple[int, ...]] = {
    "yuv422_yuy2": (48, 64, 2),
    "bgr8": (48, 64, 3),
    "rgb8": (48, 64, 3),
    "mono8": (48, 64),
}


class Still:
    """A source that shows one grey picture for ever, as a looped video of one frame would."""

    name = "still"
    width, height = 64, 48

    def __init__(self, encoding: Encoding, data: NDArray[np.uint8]) -> None:
        self.encoding, self._data, self._index = encoding, data, -1

    def read(self) -> Frame:
        self._index += 1
        return Frame(self._index, now_ns(), 64, 48, self.encoding, self._data.copy())

    def close(self) -> None:
        self._data = self._data[:0]


def grey(encoding: Encoding) -> FrameSource:
    return Still(encoding, np.full(SHAPES[encoding], 128, np.uint8))


def pictures(encoding: Encoding, nonce: str, count: int = 50) -> list[bytes]:
    source = Stamped(grey(encoding), nonce)
    return [source.read().data.tobytes() for _ in range(count)]


@pytest.mark.parametrize("encoding", SHAPES)
def test_a_picture_that_stands_still_is_never_the_same_twice_but_for_the_same_nonce(encoding: Encoding) -> None:
    runs = [picture for _ in range(3) for picture in pictures(encoding, token_hex(8))]
    assert len(set(runs)) == len(runs) == 150
    assert pictures(encoding, "again") == pictures(encoding, "again")


@pytest.mark.parametrize("encoding", SHAPES)
def test_only_the_corner_changes(encoding: Encoding) -> None:
    source = Stamped(grey(encoding), "n")
    data = source.read().data
    assert data.shape == SHAPES[encoding]
    assert (data[2 * SIDE :] == 128).all()
    assert (data[:, 2 * SIDE :] == 128).all()
    assert (data[: 2 * SIDE, : 2 * SIDE] != 128).any()


def test_frames_differ_after_jpeg_too() -> None:
    source = Stamped(grey("bgr8"), "n")
    assert len({decode_image(encode_jpeg(to_bgr(source.read()))).tobytes() for _ in range(100)}) == 100


def test_the_synthetic_camera_differs_for_longer_than_its_path_is_long() -> None:
    camera = Stamped(SyntheticCamera("", 16, 16, fps=10), "n")
    # 800 frames at 10 fps are 80 s; the path repeats after 77 s
    assert len({camera.read().data.tobytes() for _ in range(800)}) == 800


def test_a_small_picture_and_one_that_may_not_be_written_to_are_stamped_as_well() -> None:
    data = np.full((6, 10, 3), 128, np.uint8)
    data.flags.writeable = False

    class Fixed(Still):
        def read(self) -> Frame:
            return replace(super().read(), width=10, height=6, data=data)

    frames = [Stamped(Fixed("bgr8", data), nonce).read() for nonce in "ab"]
    assert frames[0].data.tobytes() != frames[1].data.tobytes()
    assert (data == 128).all()


def test_a_picture_that_the_source_compressed_passes_as_it_is() -> None:
    jpeg = cv2.imencode(".jpg", bgr_to_rgb(np.zeros((48, 64, 3), np.uint8)))[1].reshape(-1)
    source = Stamped(Still("jpeg", jpeg), "n")
    np.testing.assert_array_equal(source.read().data, jpeg)


def test_it_is_the_source_otherwise() -> None:
    source = Stamped(SyntheticCamera("", 64, 48), "n")
    assert (source.name, source.width, source.height, source.encoding) == ("synthetic", 64, 48, "yuv422_yuy2")
    assert [source.read().index for _ in range(3)] == [0, 1, 2]
    source.close()
    with pytest.raises(Exception, match="closed"):
        source.read()
