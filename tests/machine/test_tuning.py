"""What tunes a process happens only where it is allowed, and only as long."""

import os
from collections.abc import Iterator

import cv2
import pytest

from s2a_bench.machine import tuning


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Start with two threads everywhere, and leave OpenCV as it was."""
    before = cv2.getNumThreads()
    for name in tuning.SINGLE_THREADED:
        monkeypatch.delenv(name, raising=False)
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("threads")
def test_nothing_changes_unless_it_is_allowed() -> None:
    assert not tuning.is_allowed()
    tuning.limit_threads()
    assert cv2.getNumThreads() == 2
    assert not set(tuning.SINGLE_THREADED) & set(os.environ)
    assert tuning.keep_large_blocks() is False


@pytest.mark.usefixtures("threads")
def test_opencv_and_numeric_libraries_run_on_one_thread_as_long_as_that_is_allowed() -> None:
    with tuning.allowed():
        tuning.limit_threads()
        with tuning.allowed(False):
            assert tuning.is_allowed(), "what the outer program allowed stays allowed"
        with tuning.allowed():
            tuning.limit_threads()
        assert cv2.getNumThreads() == 1
        assert {os.environ[name] for name in tuning.SINGLE_THREADED} == {"1"}
    assert not tuning.is_allowed()
    assert cv2.getNumThreads() == 2
    assert not set(tuning.SINGLE_THREADED) & set(os.environ)


@pytest.mark.usefixtures("threads")
def test_what_the_user_decided_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    with tuning.allowed():
        tuning.limit_threads()
        assert os.environ["OMP_NUM_THREADS"] == "4"
    assert os.environ["OMP_NUM_THREADS"] == "4"
