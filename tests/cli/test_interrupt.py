"""Ctrl-C ends a command wherever it arrives."""

from __future__ import annotations

import subprocess
import sys

import pytest

DROPPED = """
import signal, time
from s2a_bench import cli

class Loan:
    def __del__(self):
        signal.raise_signal(signal.{signal})

def command():
    Loan()
    time.sleep(20)

cli.check_limits = command
cli.main()
"""


@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
def test_a_signal_that_arrives_in_a_destructor_ends_the_command_all_the_same(signal: str) -> None:
    code = DROPPED.format(signal=signal)
    program = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False)
    assert program.returncode == 130
    assert program.stderr == "interrupted\n"
