"""The error of a process that died: a server, and a cell of a sweep."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from threading import Timer
from typing import Any

import pytest

from s2a_bench.errors import ServerDied
from s2a_bench.harness import processes
from s2a_bench.harness.processes import LlamaServerProcess, OwnProcess, ServerProcess, keep_serving
from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import RAW_PROMPT
from s2a_bench.machine.tuning import start_child
from s2a_bench.sweep.perform import _outside
from s2a_bench.testing.transport import wiring_of
from s2a_bench.transport import Program


class Dies(ServerProcess):
    """Kills itself, as an illegal instruction would."""

    def __init__(self, log: Path, number: str) -> None:
        code = f"import os, signal; os.kill(os.getpid(), signal.{number})"
        super().__init__("http", [sys.executable, "-c", code], log)

    def wait_ready(self) -> None:
        assert self.ends_within(20)
        raise self.death()


def test_a_server_that_met_an_illegal_instruction_says_to_set_up_again(tmp_path: Path) -> None:
    with Dies(tmp_path / "log", "SIGILL") as server, pytest.raises(ServerDied) as error:
        server.wait_ready()
    assert "died, killed by signal 4 (SIGILL): llama.cpp was compiled for another processor" in str(error.value)
    assert "; run `make setup` again; its log is" in str(error.value)


def test_a_server_that_does_not_start_says_its_last_lines_and_where_its_log_is(tmp_path: Path) -> None:
    log = tmp_path / "server-http-launch-2.log"
    with OwnProcess("http", "s2a_bench.nothing", "{}", log) as server, pytest.raises(ServerDied) as error:
        server.wait_ready()
    start, *lines, where = re.split(": |; ", str(error.value))
    assert start == "the http server did not start, exit code 1"
    assert lines[-1] == "No module named s2a_bench.nothing"
    assert where == f"its log is {log}"
    assert lines[-1] in log.read_text()


ENDS = {
    "os.kill(os.getpid(), 9)": "killed by signal 9",
    "os.abort()": "killed by signal 6",
    "os._exit(3)": "exit code 3",
    "os.write(1, b'{'); os._exit(3)": "exit code 3",
}


@pytest.mark.parametrize(("end", "hour"), [*((end, "after") for end in ENDS), ("os._exit(3)", "before")])
def test_a_server_that_ends_before_its_first_line_says_how(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str, hour: str
) -> None:
    """It ends before its job is written, or after it has read it."""
    read = "sys.stdin.readline(); " if hour == "after" else ""
    (tmp_path / "dies.py").write_text(f"import os, sys; {read}{end}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)

    def start_late(*command: Any, **options: Any) -> subprocess.Popen[bytes]:
        child = start_child(*command, **options)
        if hour == "before":
            os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        return child

    monkeypatch.setattr(processes, "start_child", start_late)
    log = tmp_path / "log"
    with pytest.raises(ServerDied) as error, OwnProcess("http", "dies", "{}", log) as server:
        server.wait_ready()
    assert str(error.value) == f"the http server did not start, {ENDS[end]}; its log is {log}"


def test_a_signal_that_breaks_no_wait_off_ends_a_server_all_the_same() -> None:
    late: list[int] = []

    def ready(server: ServerProcess) -> None:
        def kill() -> None:
            late.append(server.pid)
            os.kill(server.pid, signal.SIGKILL)

        guard.append(Timer(30, kill))
        guard[0].start()
        Timer(0.3, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGINT)).start()  # another thread gets it

    guard: list[Timer] = []
    died: list[str] = []
    keep_serving(ServerJob(wiring_of("http/binary"), EngineConfig(name="echo")), ready, died.append)
    guard[0].cancel()
    assert not late
    assert not died


def test_a_named_llama_server_gets_the_vision_tower_and_the_template_that_there_are(tmp_path: Path) -> None:
    program = tmp_path / "llama-server"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)

    def command(engine: EngineConfig) -> list[str]:
        named = Program("llama-server", program, 0)
        with LlamaServerProcess(named, engine, tmp_path / "log", ignore_end=False) as server:
            flags: list[str] = server.facts["command"]
        return flags

    texts = EngineConfig(model=tmp_path / "texts.gguf")
    assert not {"--mmproj", "--no-mmproj-offload", "--chat-template"} & {*command(texts)}
    flags = command(texts.but(mmproj=tmp_path / "tower.gguf", chat_template="none"))
    assert flags[flags.index("--mmproj") + 1] == str(tmp_path / "tower.gguf")
    assert flags[flags.index("--chat-template") + 1] == RAW_PROMPT
    assert "--no-mmproj-offload" in flags


def test_a_cell_of_a_sweep_that_met_an_illegal_instruction_says_so_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nkill -ILL $$\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    assert _outside([], tmp_path / "log").endswith("run `make setup` again")
