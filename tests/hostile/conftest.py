"""Our servers that hostile clients meet, each started at its first one; and a run that is killed."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from s2a_bench.store.run import read_run
from tests.cli.program import command
from tests.hostile.peers import Target, family, target
from tests.waiting import until


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Target]]:
    folder = tmp_path_factory.mktemp("servers")
    with ExitStack() as stack:
        yield cache(lambda name: stack.enter_context(target(name, folder / name.replace("/", "-"))))


@dataclass(frozen=True)
class KilledRun:
    """A run over every kind of transport that was ended by SIGKILL, and what was seen of it before."""

    folder: Path
    rows: int
    """Whole lines of its samples just before the kill."""
    servers: list[int]
    """Process ids."""
    sockets: list[tuple[str, str, str]]
    """Kind, own and other address of each socket on a network, in the hexadecimal of /proc."""
    calls: set[str]
    """Addresses and names that Python's sockets were given."""
    files: str
    """All files that its processes had open or mapped."""


SPY = """
import os, sys

def note(event, arguments):
    if event in ("socket.bind", "socket.connect", "socket.sendto", "socket.getaddrinfo"):
        address = arguments[0 if event == "socket.getaddrinfo" else 1]
        with open(os.environ["SPY"], "a") as file:
            file.write(f"{address[0] if isinstance(address, tuple) else address}\\n")

sys.addaudithook(note)
"""


@pytest.fixture(scope="session")
def killed_run(tmp_path_factory: pytest.TempPathFactory) -> KilledRun:
    place = tmp_path_factory.mktemp("killed")
    (place / "sitecustomize.py").write_text(SPY)
    paths = os.pathsep.join([str(place), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    environ = {**os.environ, "PYTHONPATH": paths, "SPY": str(place / "spied")}
    options = ("--engine", "echo", "--size", "64x48", "--data-only", "--requests", "1000000")
    every = ("--transport", "http,ros,zmq,websocket", "--output", place / "runs")
    with subprocess.Popen(command("latency", *options, *every), env=environ, stderr=subprocess.PIPE) as process:
        try:
            until(lambda: _rows(place / "runs") > 60 or process.poll() is not None, 120)
            assert process.poll() is None, process.communicate()[1]
            (folder,) = (place / "runs").iterdir()
            servers = [server["pid"] for server in read_run(folder).manifest["servers"].values()]
            pids = [*family(process.pid)]
            sockets, files = _sockets(pids), "".join(Path(f"/proc/{pid}/maps").read_text() for pid in pids)
            files += " ".join(_opened(pids))
            rows = _rows(place / "runs")
        finally:
            process.kill()
    return KilledRun(folder, rows, servers, sockets, {*(place / "spied").read_text().splitlines()}, files)


def _rows(runs: Path) -> int:
    return sum(path.read_text().count("\n") - 1 for path in runs.glob("*/samples.csv"))


def _opened(pids: list[int]) -> Iterator[str]:
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                yield str(link.readlink())


def _sockets(pids: list[int]) -> list[tuple[str, str, str]]:
    inodes = {*_opened(pids)}
    return [
        (kind, *line.split()[1:3])
        for kind in ("tcp", "tcp6", "udp", "udp6")
        for line in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]
        if f"socket:[{line.split()[9]}]" in inodes
    ]
