"""Hostile and honest clients together on a server: ``python -m benchmarks.soak http|ros|... [--minutes M]``.

The server is a `serve` process, and so is its twin, which is not attacked: the idle latency of the one is divided by
that of the other in interleaved blocks, before the load and after it, so that what else the machine does cancels out.
The hostile clients are those of `tests/hostile/wires`. They load the server before anything is measured too: the
memory that a pool keeps for good is no growth. Prints what came of it, writes it as JSON, and exits with 1 where a
promise is broken.
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
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from threading import Event, Lock, Thread
from typing import Any

import httpx
import numpy as np

from s2a_bench.errors import RequestFailed, S2AError
from s2a_bench.stats.batches import Blocks
from s2a_bench.stats.change import ratio_of_launches
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.transport.http.native import PATHS
from s2a_bench.types import Request
from tests.hostile.asking import Usage, family, usage
from tests.hostile.suite import Attack, Case
from tests.hostile.wires import http, ros, shm, websocket, zmq

PROMPT, TOKENS = "go on and stop", 8
PATIENCE_S, READY_S, SETTLES_S, ENDS_S = 120.0, 300.0, 45.0, 60.0
SILENCE_S = 30.0
"""Over ROS the last messages of an answer may be lost: a client hears nothing, and asks again."""
WARM_UP, WARM_UP_S = 0.2, 30.0
"""Of the minutes, before them, and at least so long: what a server keeps for good it has by then. More where not every
hostile client has come as often as there are attackers."""
HOSTILE = {
    "http": http.CLIENTS,
    "http/best-effort": http.FAST,
    "ros": ros.CLIENTS,
    "shm": shm.CLIENTS,
    "websocket": websocket.CLIENTS,
    "zmq": zmq.CLIENTS,
}
WARM_UP_ONLY = frozenset({"a prompt of 16 MiB", "8 requests of 16 MiB"})
"""Over ROS requests are received on many threads, and glibc keeps the most that each ever held (machine/tuning.py):
with these the memory swings by 150 MiB, which would hide growth."""
HONEST = {
    "http": ("http", "http", "whole"),
    "http/best-effort": ("http/best-effort", "http/binary", "whole"),
    "ros": ("ros/topic", "ros/topic", "ros/action"),
    "shm": ("shm", "shm", "shm"),
    "websocket": ("websocket", "websocket/openpi-stream", "websocket"),
    "zmq": ("zmq", "zmq?layout=n1.7", "zmq?layout=n1.5"),
}
"""What the honest clients speak; "whole" is an answer that is not streamed."""
ATTACKERS = 3
BLOCKS = 15
"""Of idle latencies, before the load and after it."""
BLOCK = {"echo": 20}
"""Requests of a block of idle latencies; of an engine that computes a quarter."""
GROWTH_MIB, PEAK_MIB, SLOWER = 20.0, 1024.0, 1.2
LAZY, LAZY_POOL = 4, 66
"""Threads that may start later than the warm-up; as deployed's pool may start all it has: a leak has more still."""
KEPT = {"zmq": 8}
"""Sockets of peers that are gone and sent what another connected peer had sent: libzmq reads them no further."""
REFUSED = re.compile(r"requests are waiting|are under way|rejected the goal|answered 503")
LOST = re.compile(r"^(no token|no feedback) for|letters|came instead of|marks did not arrive")


@dataclass
class Served:
    """A `serve` process."""

    process: subprocess.Popen[str]
    address: str


@dataclass
class Result:
    """What came of a soak."""

    transport: str
    engine: str
    minutes: float
    asked: int = 0
    answered: int = 0
    refused: int = 0
    """Honest requests that the server refused for now."""
    lost: int = 0
    """Answers with lost messages, by an error or a timeout; the client repeated the request."""
    failed: list[str] = field(default_factory=list)
    attacks: int = 0
    not_met: list[str] = field(default_factory=list)
    """Hostile clients that never came."""
    idle_ms_before: float = 0.0
    idle_ms_after: float = 0.0
    slower: float | None = None
    """Idle latency after by before, each relative to the twin's."""
    slower_low: float | None = None
    slower_high: float | None = None
    before: Usage | None = None
    after: Usage | None = None
    peak_mib: float = 0.0
    survived: bool = False
    ended_s: float = 0.0
    exit_code: int | None = None

    @property
    def lazy(self) -> int:
        """Return how many threads the server may start late."""
        return LAZY_POOL if self.transport == "http" else LAZY

    @property
    def growth_mib(self) -> float:
        """Return how much more resident memory the server has than before the load."""
        return self.after.rss_mib - self.before.rss_mib if self.before and self.after else 0.0

    def broken(self) -> list[str]:
        """Return the promises that were broken."""
        before, after = self.before, self.after
        assert before  # noqa: S101 - measured
        assert after  # noqa: S101 - measured
        promises = {
            "the server ended under the load": self.survived,
            f"{self.asked - self.answered} of {self.asked} honest requests were not answered: {self.failed[:3]}": (
                self.asked == self.answered > 0
            ),
            f"{after.threads - before.threads} threads are left": after.threads <= before.threads + self.lazy,
            f"{after.descriptors - before.descriptors} descriptors are left": (
                after.descriptors <= before.descriptors + KEPT.get(self.transport, 0)
            ),
            f"the memory has grown by {self.growth_mib:.0f} MiB": self.growth_mib < GROWTH_MIB,
            f"the server held {self.peak_mib:.0f} MiB": self.peak_mib < PEAK_MIB,
            f"the idle latency is {self.slower or 0:.2f} times that of before": (self.slower_low or 0) <= SLOWER,
            f"these hostile clients never came: {self.not_met}": not self.not_met,
            f"SIGTERM ended it in {self.ended_s:.1f} s with {self.exit_code}": self.exit_code == 0,
        }
        return [text for text, kept in promises.items() if not kept]


@contextmanager
def served(transport: str, engine: str, name: str, log: Path) -> Iterator[Served]:
    """Run `serve`, which ends with the context; what it writes to standard error goes to ``log``."""
    line = [sys.executable, "-m", "s2a_bench", "serve", transport, "--engine", engine]
    own: dict[str, tuple[list[str], str]] = {
        "http": (["--port", "0"], r"http://[\d.:]+"),
        "ros": (["--namespace", f"/{name}_{os.getpid()}", "--max-tokens", str(TOKENS)], rf"/{name}_\d+"),
        "shm": ([], r"/\S+\.sock"),
        "websocket": (["--port", "0"], r"ws://[\d.:]+"),
        "zmq": (["--port", "0"], r"tcp://[\d.:]+"),
    }
    flags, address = own[transport.partition("/")[0]]
    line += flags
    with (
        log.open("a") as errors,
        subprocess.Popen(line, stdout=subprocess.PIPE, stderr=errors, text=True) as process,  # noqa: S603 - ours
    ):
        try:
            assert process.stdout  # noqa: S101 - a pipe
            if not select.select([process.stdout], [], [], READY_S)[0]:
                raise TimeoutError(f"the server printed nothing for {READY_S:g} s")
            first = process.stdout.readline()
            if (found := re.search(address, first)) is None:
                raise RuntimeError(f"the server printed no address: {first}")
            yield Served(process, found[0])
        finally:
            process.kill()


def wiring(name: str, address: str) -> Wiring[Any]:
    """Return what a client of a server is told."""
    silence_s = SILENCE_S if name.startswith("ros") else PATIENCE_S
    return wiring_of(name, address, timeout_s=silence_s, max_tokens=TOKENS)


class Honest:
    """An honest client: it repeats a refused request, and checks its answer."""

    def __init__(self, name: str, address: str) -> None:
        """Connect."""
        self._url = address + PATHS["as-deployed"]
        self._client: Client | None = None if name == "whole" else open_client(wiring(name, address))

    def ask(self) -> int:
        """Return how many tokens answered; raises RequestFailed."""
        if self._client is not None:
            return len(ask(self._client, Request(f"soak-{random.random()}", PROMPT, max_tokens=TOKENS))[0])  # noqa: S311
        body = {"messages": [{"role": "user", "content": PROMPT}], "max_tokens": TOKENS}
        try:
            answer = httpx.post(self._url, json=body, timeout=PATIENCE_S, trust_env=False)
        except httpx.HTTPError as error:
            raise RequestFailed(f"whole: {type(error).__name__}: {error}") from error
        if answer.is_error:
            raise RequestFailed(f"answered {answer.status_code}: {answer.text}")
        return int(answer.json()["usage"]["completion_tokens"])

    def close(self) -> None:
        """Leave."""
        if self._client is not None:
            self._client.close()


class Load:
    """Clients of both kinds, each on its own thread, until the end."""

    def __init__(self, result: Result, address: str, cases: Sequence[Case[Attack]]) -> None:
        """Start nothing yet."""
        self._result, self._address, self.cases = result, address, cases
        self._over, self._lock = Event(), Lock()
        self.attacks: Counter[str] = Counter()

    def run(self, seconds: float, *, at_least: int = 0) -> None:
        """Load the server for so long, and until each hostile client has come ``at_least`` so often."""
        names = HONEST[self._result.transport]
        threads = [Thread(target=self._honest, args=(name,)) for name in names]
        threads += [Thread(target=self._hostile, args=(seed,)) for seed in range(ATTACKERS)]
        for thread in threads:
            thread.start()
        time.sleep(seconds)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and any(self.attacks[case.name] < at_least for case in self.cases):
            time.sleep(0.1)
        self._over.set()
        for thread in threads:
            thread.join()

    def _honest(self, name: str) -> None:
        try:
            with closing(Honest(name, self._address)) as client:
                while not self._over.is_set():
                    error = self._insist(client)
                    with self._lock:
                        self._result.asked += 1
                        self._result.answered += not error
                        self._result.failed += [f"{name}: {error}"] * bool(error)
                    time.sleep(0.02)
        except S2AError as error:
            with self._lock:
                self._result.asked += 1
                self._result.failed.append(f"{name}: {error}")

    def _insist(self, client: Honest) -> str:
        """Ask until answered, for as long as it is refused or messages are lost; return what was wrong."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                tokens = client.ask()
            except S2AError as error:
                refused, lost = bool(REFUSED.search(str(error))), bool(LOST.search(str(error)))
                with self._lock:
                    self._result.refused += refused
                    self._result.lost += lost
                if not (refused or lost) or time.monotonic() > deadline:
                    return f"{type(error).__name__}: {error}"[:300]
                time.sleep(0.2)
            else:
                return "" if tokens else "an empty answer"

    def _hostile(self, seed: int) -> None:
        cases = [*self.cases]
        chosen = random.Random(seed)  # noqa: S311 - not secret
        while not self._over.is_set():
            chosen.shuffle(cases)
            for case in cases:
                if self._over.is_set():
                    return
                self.attack(case)

    def attack(self, case: Any) -> None:
        """Let one hostile client do its work."""
        with suppress(OSError, S2AError):  # whatever becomes of it
            case.does(wiring(HONEST[self._result.transport][0], self._address))
        with self._lock:
            self.attacks[case.name] += 1


def idle(client: Client, twin: Client, blocks: int, of: int) -> tuple[list[float], Blocks]:
    """Return the latencies in ms of interleaved blocks, and by block those relative to the twin's median."""
    plain: list[float] = []
    relative: list[float] = []
    for block in range(blocks):
        taken: dict[bool, list[float]] = {}
        for loaded in (True, False) if block % 2 else (False, True):
            taken[loaded] = [latency_ms(client if loaded else twin) for _ in range(of)]
        plain += taken[True]
        relative += [value / median(taken[False]) for value in taken[True]]
    return plain, Blocks(np.array(relative), np.repeat(np.arange(blocks), of))


def latency_ms(client: Client, tries: int = 5) -> float:
    """Return how long one whole answer takes; a lost one is requested again."""
    began = time.perf_counter()
    try:
        ask(client, Request("idle", PROMPT, max_tokens=TOKENS))
    except RequestFailed as error:
        if tries == 1 or not LOST.search(str(error)):
            raise
        return latency_ms(client, tries - 1)
    return (time.perf_counter() - began) * 1e3


def settled(pid: int, before: Usage, lazy: int, client: Client) -> Usage:
    """Return what the server uses once nothing is left, or `SETTLES_S` are over; requests let its pool shrink."""
    deadline = time.monotonic() + SETTLES_S
    while True:
        now = usage(pid)
        given_back = now.rss_mib < before.rss_mib + GROWTH_MIB  # what held large messages goes back after a while
        left = now.threads > before.threads + lazy or now.descriptors > before.descriptors or not given_back
        if not left or time.monotonic() > deadline:
            return now
        with suppress(S2AError):
            latency_ms(client)
        time.sleep(0.5)


def soak(transport: str, engine: str, minutes: float, log: Path, blocks: int = BLOCKS) -> Result:
    """Load a server for so long, and until each hostile client has come; return what came of it."""
    result, cases = Result(transport, engine, minutes), [*HOSTILE[transport]]
    with ExitStack() as stack:
        server = stack.enter_context(served(transport, engine, "soak", log))
        twin = stack.enter_context(served(transport, engine, "twin", log))
        pid = server.process.pid

        def quiet(before: Usage | None, blocks: int) -> tuple[Usage, list[float], Blocks]:
            with ExitStack() as clients:  # one that does not read for minutes would have heard all the attackers
                name = HONEST[transport][0]
                client, other = (
                    clients.enter_context(closing(open_client(wiring(name, each.address)))) for each in (server, twin)
                )
                idle(client, other, 1, 5)
                uses = settled(pid, before or usage(pid), result.lazy, client)
                return uses, *idle(client, other, blocks, BLOCK.get(engine, 5))

        bare, _, _ = quiet(None, 1)
        warm_up = Load(Result(transport, engine, minutes), server.address, cases)
        warm_up.run(max(minutes * 60 * WARM_UP, WARM_UP_S), at_least=ATTACKERS)
        result.before, plain_before, relative_before = quiet(bare, blocks)
        processes = [*family(pid)]
        load = Load(result, server.address, [case for case in cases if case.name not in WARM_UP_ONLY])
        load.run(minutes * 60, at_least=1)
        result.after, plain_after, relative_after = quiet(result.before, blocks)
        result.survived = server.process.poll() is None and processes == [*family(pid)]
        result.peak_mib, result.attacks = usage(pid).peak_mib, load.attacks.total()
        result.not_met = sorted({case.name for case in load.cases} - {*load.attacks})
        result.idle_ms_before, result.idle_ms_after = median(plain_before), median(plain_after)
        later = Blocks(relative_after.values, relative_after.block + blocks)
        if (ratio := ratio_of_launches({0: later}, {0: relative_before}, 1)) is not None:
            result.slower, result.slower_low, result.slower_high = ratio.value, ratio.low, ratio.high
        began = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            result.exit_code = server.process.wait(ENDS_S)
        result.ended_s = time.monotonic() - began
    return result


def result_json(result: Result) -> dict[str, Any]:
    """Return it as plain data."""
    plain = {name: value for name, value in vars(result).items() if name not in {"before", "after", "failed"}}
    uses = {name: asdict(use) for name in ("before", "after") if (use := getattr(result, name))}
    counts = {"failed": len(result.failed), "failures": result.failed[:20], "growth_mib": result.growth_mib}
    return {**plain, **uses, **counts, "broken": result.broken()}


def main() -> None:
    """Soak, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("transport", choices=[*HOSTILE])
    parser.add_argument("--engine", default="echo", help="echo, llama (the tiny dummy), ...")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--blocks", type=int, default=BLOCKS, help="of idle latencies, before the load and after it")
    parser.add_argument("--output", type=Path, help="[default: soak-TRANSPORT-ENGINE.json]")
    given = parser.parse_args()
    output = given.output or Path(f"soak-{given.transport.replace('/', '-')}-{given.engine}.json")
    log = output.with_suffix(".log")
    whole = result_json(soak(given.transport, given.engine, given.minutes, log, given.blocks))
    text = json.dumps(whole, indent=1)
    output.write_text(text + "\n")
    print(text)
    sys.exit(1 if whole["broken"] else 0)


if __name__ == "__main__":
    main()
