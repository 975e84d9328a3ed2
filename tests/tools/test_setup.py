"""The set-up script says what is missing before it downloads anything."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def setup(tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "tools" / "setup.py")],
        env={"S2A_BENCH_VENV": str(tmp_path / "venv"), **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_a_missing_compiler_is_one_line_at_once(tmp_path: Path) -> None:
    done = setup(tmp_path, PATH=str(tmp_path))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("setup: no C++ compiler found")
    assert "apt install build-essential" in line
    assert not (tmp_path / "venv").exists()


def test_a_compiler_that_the_user_named_but_is_missing_counts_as_none(tmp_path: Path) -> None:
    done = setup(tmp_path, PATH=os.environ["PATH"], CXX="no-such-compiler")
    assert "no C++ compiler found" in done.stderr


def lines_with(name: str, file: str) -> list[str]:
    return [line.strip().strip('",') for line in (ROOT / file).read_text().splitlines() if name in line]


def test_the_pinned_llama_cpp_is_the_required_one() -> None:
    assert lines_with("llama-cpp-python==", "constraints.txt") == lines_with("llama-cpp-python==", "pyproject.toml")
