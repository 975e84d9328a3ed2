"""What ``--source`` accepts, and how it says no."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2a_bench.errors import SourceError, UsageError
from s2a_bench.frames import SOURCES, open_source
from s2a_bench.frames.synthetic import SyntheticCamera


def test_the_synthetic_camera_opens_with_its_settings() -> None:
    source = open_source("synthetic", 32, 16, fps=12.5, seed=9)
    assert isinstance(source, SyntheticCamera)
    assert (source.width, source.height, source.fps) == (32, 16, 12.5)
    assert source.read().data.tobytes() == SyntheticCamera("", 32, 16, fps=12.5, seed=9).read().data.tobytes()


@pytest.mark.parametrize("spec", ["webcam", "", "http://camera", "Synthetic"])
def test_an_unknown_scheme_lists_those_there_are(spec: str) -> None:
    with pytest.raises(UsageError) as caught:
        open_source(spec, 64, 48)
    message = str(caught.value)
    assert message.startswith(f"`source`: '{spec.partition(':')[0]}'")
    assert all(scheme in message for scheme in SOURCES)


def test_a_scheme_has_its_path_and_no_other() -> None:
    for scheme, where in (("video", "FILE"), ("images", "FOLDER"), ("v4l2", "DEVICE")):
        with pytest.raises(UsageError, match=f"`source`: '{scheme}' should be {scheme}:{where}"):
            open_source(scheme, 64, 48)
    with pytest.raises(UsageError, match="should be plain 'synthetic'"):
        open_source("synthetic:x", 64, 48)


@pytest.mark.parametrize(
    ("scheme", "what"),
    [("video", "no video file at"), ("images", "no folder at"), ("v4l2", ""), ("bag", "no recording at")],
)
def test_a_path_that_is_missing_is_named(scheme: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / "with:colon"
    with pytest.raises(SourceError, match=f"^`source`: {what}.*{path}"):
        open_source(f"{scheme}:{path}", 64, 48)
