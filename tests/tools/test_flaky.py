"""CI names the tests that passed only when run again, and keeps their logs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
TESTS = """
from pathlib import Path
import pytest

def passes_from_the_second_time_on(name):
    before = Path(__file__).with_name(name).exists()
    Path(__file__).with_name(name).touch()
    print("a word of the server")
    assert before, "not yet"

class TestNow:
    @pytest.mark.parametrize("n", [1, 2])
    def test_flaky(self, n): passes_from_the_second_time_on(str(n))

def test_broken(): assert 1 == 2
def test_fine(): pass
@pytest.fixture
def late(): passes_from_the_second_time_on("late")
def test_late(late): pass
"""


def test_what_failed_and_then_passed_is_a_defect_with_its_log(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_now.py").write_text(TESTS)
    for name in ("first.xml", "again.xml"):
        plain = ["-c", "/dev/null", "--rootdir", ".", "-o", "junit_family=xunit1", "-o", "junit_logging=all"]
        line = [sys.executable, "-m", "pytest", "-q", *plain, "-p", "no:randomly", f"--junitxml={name}", "tests"]
        done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 1, done.stderr
    line = [sys.executable, ROOT / "tools" / "flaky.py", "first.xml", "again.xml", "logs"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True)
    flaky, other, late = done.stdout.splitlines()
    failed = "failed, then passed when run again"
    assert flaky.startswith(
        f"DEFECT: tests/test_now.py::TestNow::test_flaky[1] {failed}: AssertionError: not yet (log: "
    )
    assert other.startswith(f"DEFECT: tests/test_now.py::TestNow::test_flaky[2] {failed}")
    assert late.startswith(f"DEFECT: tests/test_now.py::test_late {failed}")
    log = (tmp_path / flaky.partition("(log: ")[2].rstrip(")")).read_text()
    assert "assert before" in log
    assert "a word of the server" in log


def test_without_a_report_of_the_second_run_nothing_is_said(tmp_path: Path) -> None:
    line = [sys.executable, ROOT / "tools" / "flaky.py", tmp_path / "first.xml", tmp_path / "again.xml", tmp_path]
    assert subprocess.run(line, capture_output=True, text=True, check=True).stdout == ""
