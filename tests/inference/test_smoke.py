"""The smoke test says how llama.cpp's process ended, and tests that load models survive its death."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import pytest

from s2a_bench.inference import smoke
from s2a_bench.inference.smoke import Smoke, main, smoke_test

DIES = "import os, signal; print('f16'); print('q8_0', flush=True); os.kill(os.getpid(), signal.SIGILL)"


def child(code: str) -> list[str]:
    return [sys.executable, "-c", code]


@pytest.mark.slow
def test_this_build_answers_with_every_type_of_weights_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert smoke_test() == Smoke(0)
    assert list(tmp_path.iterdir()) == []


def test_a_death_names_weights_signal_and_the_way_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(smoke, "CHILD", child(DIES))
    monkeypatch.setattr(sys, "argv", ["smoke"])
    assert main() == 128 + 4
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("llama.cpp failed its test with q8_0 weights: killed by signal 4 (SIGILL)")
    assert line.endswith("run `make setup` again")


def test_another_failure_is_told_by_its_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoke, "CHILD", child("raise OSError('libgomp.so.1: no such file')"))
    assert smoke_test() == Smoke(
        1, "llama.cpp failed its test with no weights: exit code 1: OSError: libgomp.so.1: no such file"
    )


def test_no_answer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoke, "CHILD", child("import time; time.sleep(60)"))
    monkeypatch.setattr(smoke, "LONGEST_S", 0.1)
    seen = smoke_test()
    assert seen.code == 1
    assert "gave no answer" in seen.message
