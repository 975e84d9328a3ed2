"""Hostile and normal clients together on a server: ``python -m benchmarks.soak http|ros|... [--minutes M]``.

The server is a `serve` process; the hostile clients are those of `tests/hostile/wires`. They come before anything is
measured, too: the memory that a pool keeps for good is no growth. Prints what came of it, writes it as JSON, and exits
with 1 where a promise is broken.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import select
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

from s2a_bench.errors import S2AError
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import Wiring, open_client
from s2a_bench.types import Request
from tests.hostile.peers import Case, Usage, usage
from tests.hostile.wires import http, iceoryx2, ros, websocket, zmq

CLIENTS = {
    "http": ("http", http.CLIENTS + http.LARGE, ("http", "http", "http")),
    "http/best-effort": (
        "http/best-effort",
        http.FAST + http.FAST_LARGE,
        ("http/best-effort", "http/binary", "http/binary"),
    ),
    "ros": ("ros", ros.CLIENTS + ros.LARGE, ("ros/topic", "ros/topic", "ros/action")),
    "iceoryx2": ("iceoryx2", iceoryx2.CLIENTS + iceoryx2.LARGE, ("iceoryx2", "iceoryx2", "iceoryx2?payload=png")),
    "websocket": ("websocket", websocket.CLIENTS + websocket.LARGE, ("websocket", "websocket/openpi-stream")),
    "zmq": ("zmq", zmq.CLIENTS + zmq.LARGE, ("zmq", "zmq?layout=n1.7", "zmq?layout=n1.5")),
}
"""What is served, its hostile clients, and what its normal clients speak."""
ADDRESSES = {"http": r"http://[\d.:]+", "ros": r"/soak_\d+", "iceoryx2": r"s2a-[0-9a-f]+", "websocket": r"ws://[\d.:]+"}
PORTS = frozenset({"http", "websocket", "zmq"})
FLOODS = frozenset({"300 connections at once"})
"""Hostile clients that take the places of normal ones: fairness is not promised."""
PROMPT, TOKENS = "go on and stop", 8
PATIENCE_S, SILENCE_S, READY_S, SETTLES_S, ENDS_S = 120.0, 30.0, 300.0, 45.0, 60.0
ATTACKERS = 3
WARM_UP, WARM_UP_S = 0.2, 10.0
"""Share of the minutes before them, at least so long; each hostile client comes as often as there are attackers."""
GROWTH_MIB, PEAK_MIB = 100.0, 1024.0
LAZY = 66
"""Threads of a pool that may start after the warm-up."""
REFUSED = re.compile(r"requests are waiting|are under way|rejected the goal|answered 503|open already|at once")
LOST = re.compile(r"^(no token|no feedback) for|letters|came instead of|marks did not arrive")


@dataclass
class Result:
    """What came of a soak."""

    transport: str
    engine: str
    minutes: float
    asked: int = 0
    answered: int = 0
    refused: int = 0
    """Normal requests that the server refused for now; they come again, as those do whose messages were lost."""
    lost: int = 0
    failed: list[str] = field(default_factory=list)
    attacks: int = 0
    not_met: list[str] = field(default_factory=list)
    """Hostile clients that never came."""
    before: Usage | None = None
    after: Usage | None = None
    peak_mib: float = 0.0
    survived: bool = False
    exit_code: int | None = None
    """Of the server, after SIGTERM."""

    def broken(self) -> list[str]:
        """Return the promises that were broken."""
        before, after = self.before, self.after
        assert before  # noqa: S101 - measured
        assert after  # noqa: S101 - measured
        promises = {
            "the server ended under the load": self.survived,
            f"{self.asked - self.answered} normal requests were not answered": self.asked == self.answered > 0,
            f"{after.threads - before.threads} threads are left": after.threads <= before.threads + LAZY,
            f"{after.descriptors - before.descriptors} descriptors are left": after.descriptors <= before.descriptors,
            f"the memory grew to {after.rss_mib:.0f} MiB": after.rss_mib < before.rss_mib + GROWTH_MIB,
            f"the server held {self.peak_mib:.0f} MiB": self.peak_mib < PEAK_MIB,
            f"these hostile clients never came: {self.not_met}": not self.not_met,
            f"SIGTERM ended it with {self.exit_code}": self.exit_code == 0,
        }
        return [text for text, kept in promises.items() if not kept]


@contextmanager
def served(transport: str, engine: str, log: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `serve`, which ends with the context; yield its process and address."""
    line = [sys.executable, "-m", "s2a_bench", "serve", transport, "--engine", engine]
    line += ["--port", "0"] if transport.partition("/")[0] in PORTS else []
    line += ["--namespace", f"/soak_{os.getpid()}", "--max-tokens", str(TOKENS)] if transport == "ros" else []
    with (
        log.open("a") as errors,
        subprocess.Popen(line, stdout=subprocess.PIPE, stderr=errors, text=True) as process,  # noqa: S603 - ours
    ):
        try:
            assert process.stdout  # noqa: S101 - a pipe
            if not select.select([process.stdout], [], [], READY_S)[0]:
                raise TimeoutError(f"the server printed nothing for {READY_S:g} s")
            first = process.stdout.readline()
            if (address := re.search(ADDRESSES.get(transport.partition("/")[0], r"tcp://[\d.:]+"), first)) is None:
                raise RuntimeError(f"the server printed no address: {first}")
            yield process, address[0]
        finally:
            process.kill()


def wiring(name: str, address: str) -> Wiring[Any]:
    """Return what a client of the server is told; over ROS it may hear nothing, and asks again."""
    silence_s = SILENCE_S if name.startswith("ros") else PATIENCE_S
    return wiring_of(name, address, timeout_s=silence_s, max_tokens=TOKENS)


class Load:
    """Clients of both kinds, each on its own thread, until the end."""

    def __init__(self, result: Result, address: str, cases: Sequence[Case], normal: Sequence[str]) -> None:
        """Start nothing yet."""
        self._result, self._address, self._cases, self._normal_names = result, address, cases, normal
        self._over, self._lock = Event(), Lock()
        self.attacks: Counter[str] = Counter()

    def run(self, seconds: float, *, at_least: int) -> None:
        """Load the server for so long, and until each hostile client has come ``at_least`` so often."""
        threads = [Thread(target=self._normal, args=(name,)) for name in self._normal_names]
        threads += [Thread(target=self._hostile, args=(seed,)) for seed in range(ATTACKERS)]
        for thread in threads:
            thread.start()
        self._over.wait(seconds)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and any(self.attacks[case.name] < at_least for case in self._cases):
            time.sleep(0.1)
        self._over.set()
        for thread in threads:
            thread.join()

    def _normal(self, name: str) -> None:
        while not self._over.wait(0.02):
            try:
                with closing(open_client(wiring(name, self._address))) as client:
                    while not self._over.wait(0.02):
                        self._ask(name, client)
            except S2AError as error:
                self._note(f"{name}: {error}")

    def _ask(self, name: str, client: Any) -> None:
        """Ask until answered, for as long as it is refused or messages are lost."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                ask(client, Request(f"soak-{random.random()}", PROMPT, max_tokens=TOKENS))  # noqa: S311
            except S2AError as error:
                refused, lost = bool(REFUSED.search(str(error))), bool(LOST.search(str(error)))
                with self._lock:
                    self._result.refused += refused
                    self._result.lost += lost
                if not (refused or lost) or time.monotonic() > deadline:
                    return self._note(f"{name}: {error}")
                time.sleep(0.2)
            else:
                return self._note("")

    def _note(self, error: str) -> None:
        with self._lock:
            self._result.asked += 1
            self._result.answered += not error
            self._result.failed += [error[:300]] * bool(error)

    def _hostile(self, seed: int) -> None:
        cases, chosen = [*self._cases], random.Random(seed)  # noqa: S311 - not secret
        while not self._over.is_set():
            chosen.shuffle(cases)
            for case in cases:
                if self._over.is_set():
                    return
                with suppress(OSError, S2AError):  # whatever becomes of it
                    case.does(wiring(self._normal_names[0], self._address), case.says)
                with self._lock:
                    self.attacks[case.name] += 1


def settled(pid: int, before: Usage | None) -> Usage:
    """Return what the server uses once no descriptors or memory are left, or `SETTLES_S` are over."""
    deadline = time.monotonic() + SETTLES_S
    while True:
        now = usage(pid)
        least = before or now
        left = now.descriptors > least.descriptors or now.rss_mib > least.rss_mib + GROWTH_MIB
        if time.monotonic() > deadline or (before and not left):
            return now
        time.sleep(0.5)
        before = before or now


def soak(transport: str, engine: str, minutes: float, log: Path) -> Result:
    """Load a server for so long, and until each hostile client has come; return what came of it."""
    serves, cases, normal = CLIENTS[transport]
    cases = tuple(case for case in cases if case.name not in FLOODS)
    result = Result(transport, engine, minutes)
    with served(serves, engine, log) as (process, address):
        bare = usage(process.pid)
        warm_up = Load(Result(transport, engine, minutes), address, cases, normal)
        warm_up.run(max(minutes * 60 * WARM_UP, WARM_UP_S), at_least=ATTACKERS)
        result.before = settled(process.pid, bare)
        load = Load(result, address, cases, normal)
        load.run(minutes * 60, at_least=1)
        result.after = settled(process.pid, result.before)
        result.survived = process.poll() is None
        result.peak_mib, result.attacks = usage(process.pid).peak_mib, load.attacks.total()
        result.not_met = sorted({case.name for case in cases} - {*load.attacks})
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            result.exit_code = process.wait(ENDS_S)
    return result


def main() -> None:
    """Soak, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("transport", choices=[*CLIENTS])
    parser.add_argument("--engine", default="echo", help="echo, llama (the tiny dummy), ...")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--output", type=Path, help="[default: soak-TRANSPORT-ENGINE.json]")
    given = parser.parse_args()
    output = given.output or Path(f"soak-{given.transport.replace('/', '-')}-{given.engine}.json")
    result = soak(given.transport, given.engine, given.minutes, output.with_suffix(".log"))
    whole = {**asdict(result), "failed": len(result.failed), "failures": result.failed[:20], "broken": result.broken()}
    text = json.dumps(whole, indent=1)
    output.write_text(text + "\n")
    print(text)
    sys.exit(1 if whole["broken"] else 0)


if __name__ == "__main__":
    main()
