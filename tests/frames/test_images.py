"""A folder of pictures as a camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from s2a_bench.errors import SourceError
from s2a_bench.frames import files
from s2a_bench.frames.convert import encode_jpeg, encode_png
from s2a_bench.frames.files import ImageFolder
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three pictures of one grey each, of other sizes and kinds, and what is no picture."""
    for name, grey, encode, size in (
        ("b.jpg", 20, encode_jpeg, (48, 64)),
        ("a.PNG", 10, encode_png, (20, 20)),
        ("c.png", 30, encode_png, (96, 128)),
    ):
        (tmp_path / name).write_bytes(encode(np.full((*size, 3), grey, np.uint8)).tobytes())
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "folder.png").mkdir()
    return tmp_path


class TestContract(FrameSourceSuite):
    @pytest.fixture
    def make_source(self, folder: Path) -> MakeSource:
        return lambda width, height: ImageFolder(str(folder), width, height)


def test_pictures_come_in_the_order_of_names_and_start_over(folder: Path) -> None:
    source = ImageFolder(str(folder), 64, 48)
    assert [int(source.read().data[0, 0, 0]) for _ in range(7)] == [10, 20, 30, 10, 20, 30, 10]


def test_channels_are_blue_green_red(tmp_path: Path) -> None:
    (tmp_path / "blue.png").write_bytes(encode_png(np.full((4, 4, 3), (255, 9, 0), np.uint8)).tobytes())
    assert ImageFolder(str(tmp_path), 4, 4).read().data[0, 0].tolist() == [255, 9, 0]


def test_a_folder_without_pictures_says_what_it_takes(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(SourceError, match=r"^`source`: no pictures in .*\.jpg"):
        ImageFolder(str(tmp_path), 64, 48)


def test_an_unreadable_picture_is_named_at_once(folder: Path) -> None:
    (folder / "d.jpg").write_bytes(b"no picture")
    with pytest.raises(SourceError, match=r"^`source`: cannot read .*d\.jpg: the 10 bytes are not a picture"):
        ImageFolder(str(folder), 64, 48)


def test_a_folder_too_large_to_hold_says_what_fits(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "LIMIT_BYTES", 2 * 64 * 48 * 3)
    with pytest.raises(SourceError, match="holds 3 pictures; decoded to 64x48, 2 fit"):
        ImageFolder(str(folder), 64, 48)
