"""Children end with the process that started them, and not with a thread of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from threading import Thread

import pytest

from s2a_bench.machine.tuning import start_child
from tests.waiting import ended, until

STUBBORN = (
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(600)"
)
PARENT = """
import subprocess, sys, time
from threading import Thread
from s2a_bench.machine.tuning import start_child

def start():
    child = start_child([sys.executable, "-c", sys.argv[1]], stdout=subprocess.PIPE)
    child.stdout.readline()
    print(child.pid, flush=True)

thread = Thread(target=start)
thread.start() if sys.argv[2] == "thread" else start()
time.sleep(600)
"""


@pytest.mark.parametrize("where", ["main", "thread"])
@pytest.mark.parametrize("stopped", [False, True])
def test_a_killed_parent_takes_along_children_that_ignore_signals_or_are_stopped(where: str, stopped: bool) -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT, STUBBORN, where], stdout=subprocess.PIPE) as parent:
        child = int(parent.stdout.readline())
        if stopped:
            os.kill(child, signal.SIGSTOP)
        parent.kill()
    until(lambda: ended(child), 60)


def test_a_child_lives_on_when_the_thread_that_started_it_ends() -> None:
    children: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        children.append(start_child([sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE))

    thread = Thread(target=start)
    thread.start()
    thread.join()
    with children[0] as child:
        assert child.stdout.readline() == b"ready\n"
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(0.3)
        child.kill()
        assert child.wait(60) == -signal.SIGKILL


def test_what_cannot_be_started_is_told_in_any_thread() -> None:
    errors: list[Exception] = []

    def start() -> None:
        try:
            start_child(["/no/such/program"])
        except OSError as error:
            errors.append(error)

    thread = Thread(target=start)
    thread.start()
    thread.join()
    start()
    assert [type(error) for error in errors] == [FileNotFoundError, FileNotFoundError]
