"""The servers of a run end with it, and a signal ends a server, whatever either is doing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import pytest

from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import EngineConfig
from s2a_bench.machine.tuning import start_child
from s2a_bench.testing.transport import wiring_of
from s2a_bench.transport.http.native import PATHS
from tests.cli.program import command
from tests.hostile.conftest import KilledRun
from tests.hostile.peers import CLOSED, Attack, sends
from tests.hostile.wires import http, websocket, zmq
from tests.waiting import ended, until


def test_the_servers_of_a_run_that_was_killed_end(killed_run: KilledRun) -> None:
    assert len(killed_run.servers) >= 5
    until(lambda: all(map(ended, killed_run.servers)), 60)


def child_of(process: subprocess.Popen[bytes]) -> int:
    return int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[0])


@contextmanager
def serve() -> Iterator[subprocess.Popen[bytes]]:
    line = command("serve", "http", "--engine", "echo", "--port", "0")
    with subprocess.Popen(line, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGKILL])
def test_the_process_of_serve_ends_with_it(number: signal.Signals) -> None:
    with serve() as process:
        assert process.stdout.readline()
        child = child_of(process)
        process.send_signal(number)
        assert process.wait(30) == (-number if number == signal.SIGKILL else 0)
    until(lambda: ended(child))


@pytest.mark.slow
def test_a_signal_while_it_starts_leaves_nothing() -> None:
    with serve() as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        until(lambda: bool(children.read_text()))
        child = child_of(process)
        process.terminate()
        assert process.wait(30) == 0
    until(lambda: ended(child))


STUCK = """
import pathlib, sys, time
from s2a_bench.harness import serving

class Stuck:
    facts = {}
    def generate(self, request):
        pathlib.Path(sys.argv[1]).touch()
        time.sleep(3600)
        yield
    def describe(self): return {}
    def close(self): time.sleep(3600)

serving.open_engine = lambda config: Stuck()
sys.exit(serving.main())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "asks"),
    [
        ("http", sends(http.chat(PATHS["as-deployed"], fields='"stream": true'))),
        ("http", sends(http.chat(PATHS["as-deployed"], fields='"stream": false'))),
        ("websocket", websocket.asks(websocket.GO)),
        ("zmq", zmq.greets(zmq.message(zmq.request({})))),
    ],
    ids=["http, streamed", "http, whole", "websocket", "zmq"],
)
def test_a_signal_ends_a_server_whose_engine_is_stuck(name: str, asks: Attack, tmp_path: Path) -> None:
    began, wiring = tmp_path / "began", wiring_of(name)
    job = ServerJob(wiring, EngineConfig(name="echo", answer=wiring.capabilities.answer_kinds[0])).to_json()
    line = [sys.executable, "-c", STUCK, began]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            process.stdin.write(job.encode() + b"\n")
            process.stdin.flush()
            bound = wiring_of(name, json.loads(process.stdout.readline())["address"])
            asking = Thread(target=asks, args=(bound, CLOSED))
            asking.start()
            until(began.exists)
            process.terminate()
            assert process.wait(30) == 0
        finally:
            process.kill()
    asking.join()


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
