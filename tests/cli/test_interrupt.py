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
IGNORED = """
import signal
from s2a_bench import cli

signal.signal(signal.SIGHUP, signal.SIG_IGN)
cli.check_limits = lambda: signal.raise_signal(signal.SIGHUP)
cli.app = lambda **_: 7
cli.app.info = cli.typer.models.TyperInfo()
cli.main()
"""


@pytest.mark.parametrize("signal", ["SIGINT", "SIGTERM"])
def test_a_signal_that_arrives_in_a_destructor_ends_the_command_all_the_same(signal: str) -> None:
    code = DROPPED.format(signal=signal)
    program = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False)
    assert program.returncode == 130
    assert program.stderr == "interrupted\n"


def test_a_command_under_nohup_outlives_its_terminal() -> None:
    program = subprocess.run([sys.executable, "-c", IGNORED], timeout=50, check=False)
    assert program.returncode == 7
