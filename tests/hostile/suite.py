"""Tables of hostile peers for both ends of a transport: subclass `HostileSuite`, as `test_peers` does.

Each case has measured bounds: the time until the other side has reported its error in one line, and its memory. Most
peers are silent most of the time, so several run at once, each with a process of ours alone, whose use is measured.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from selectors import EVENT_READ, DefaultSelector
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import pytest

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.errors import RequestFailed
from s2a_bench.harness.processes import OwnServer
from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import STAND_IN, EngineConfig
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.types import Request
from tests.hostile.asking import TOKENS, forget_peak, usage

Attack: TypeAlias = "Callable[[Wiring[Any]], str]"
"""A hostile client: takes the wiring of a running server, and returns the server's reply."""
Trap: TypeAlias = "Callable[[Wiring[Any]], AbstractContextManager[str]]"
"""A hostile server: its address, for as long as the context lasts."""
Does = TypeVar("Does")
End = TypeVar("End")
Outcome = TypeVar("Outcome")
FAILED = "^(RequestFailed|MessagesLost|ServerDied|TransportError): ."
"""Any error of a client."""
ROOT = Path(__file__).parents[2]
PATIENCE_S = 2.0
"""The client's ``timeout_s``, the longest silence."""
SETTLES_S = 10.0
AT_ONCE = 6


@dataclass(frozen=True, slots=True)
class Case(Generic[Does]):
    """One hostile peer: its behaviour, the other side's reply, and what it may cost the other side."""

    name: str
    does: Does
    says: str = ""
    """A regular expression for the other side's error; empty for a client that is answered."""
    seconds: float = 30.0
    mib: float = 1024.0


class ClientProcess:
    """The process that sends requests to hostile servers; if it hangs it is killed and replaced."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def ask(self, wiring: Wiring[Any], seconds: float) -> dict[str, Any]:
        """Return the outcome of one request; fails the test after ``seconds``."""
        process = self._process
        if process is None or process.poll() is not None:
            command = [sys.executable, "-c", "from tests.hostile.asking import main; main()"]
            process = self._process = subprocess.Popen(command, stdin=-1, stdout=-1, text=True, cwd=ROOT)
        assert process.stdin
        assert process.stdout
        process.stdin.write(json.dumps(wiring.to_json()) + "\n")
        process.stdin.flush()
        with DefaultSelector() as selector:
            selector.register(process.stdout, EVENT_READ)
            if not selector.select(seconds + SETTLES_S):  # the process may have to start
                peak = usage(process.pid).peak_mib
                self.close()
                pytest.fail(f"the client was still asking after {seconds + SETTLES_S:g} s, with {peak:.0f} MiB")
        line = process.stdout.readline()
        assert line, f"the client's process ended: {process.wait()}"
        outcome: dict[str, Any] = json.loads(line)
        return outcome

    def close(self) -> None:
        if self._process is not None:
            with self._process:
                self._process.kill()


@dataclass(frozen=True, slots=True)
class Attacked:
    """The outcome of a hostile client: our server's reply to it, and its answer to an honest client afterwards."""

    reply: str
    seconds: float
    peak_mib: float
    answer: list[str]
    expected: list[str]
    """The answer to the honest client before all hostile ones."""
    alive: bool
    tidy: bool


class HostileTarget:
    """Our server in a separate process, with an honest client that stays connected."""

    def __init__(self, wiring: Wiring[Any], server: OwnServer, honest: Client) -> None:
        self._wiring, self._server, self._honest = wiring, server, honest
        self._expected = honest_answer(honest)

    def attacked(self, case: Case[Attack]) -> Attacked:
        pid = self._server.pid
        before = usage(pid)
        forget_peak(pid)
        began = now_ns()
        reply = case.does(self._wiring)
        seconds = (now_ns() - began) / 1e9
        answer, peak_mib = honest_answer(self._honest), usage(pid).peak_mib
        tidy = _settled(lambda: usage(pid).descriptors <= before.descriptors)
        return Attacked(reply, seconds, peak_mib, answer, self._expected, self._server.alive(), tidy)


class HostileSuite:
    """Name the pipeline, and the cases; override `wiring` for settings that a name cannot have."""

    name: ClassVar[str]
    clients: ClassVar[Sequence[Case[Attack]]] = ()
    servers: ClassVar[Sequence[Case[Trap]]] = ()
    targets: ClassVar[int] = AT_ONCE
    """Number of our servers, each attacked by one client at a time; 1 if their address is fixed."""

    @classmethod
    def wiring(cls) -> Wiring[Any]:
        return wiring_of(cls.name, timeout_s=PATIENCE_S, max_tokens=TOKENS)

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        for fixture, cases in (("hostile_client", self.clients), ("hostile_server", self.servers)):
            if fixture in metafunc.fixturenames:
                metafunc.parametrize(fixture, cases, ids=[case.name for case in cases])

    @pytest.fixture(scope="class")
    @classmethod
    def attacked(
        cls, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
    ) -> Iterator[dict[Case[Attack], Future[Attacked]]]:
        wiring, folder = cls.wiring(), tmp_path_factory.mktemp("servers")
        with ExitStack() as stack:
            targets: list[HostileTarget] = []
            for number in range(cls.targets):
                server = stack.enter_context(own_server(wiring, folder / f"log-{number}"))
                bound = replace(wiring, address=server.address)
                honest = stack.enter_context(closing(open_client(replace(bound, timeout_s=60.0))))
                targets.append(HostileTarget(bound, server, honest))
            yield stack.enter_context(_at_once(targets, HostileTarget.attacked, _chosen(request, "hostile_client")))

    @pytest.fixture(scope="class")
    @classmethod
    def trapped(cls, request: pytest.FixtureRequest) -> Iterator[dict[Case[Trap], Future[dict[str, Any]]]]:
        """The outcomes of requests to the hostile servers of all selected tests."""

        def send(client: ClientProcess, case: Case[Trap]) -> dict[str, Any]:
            with case.does(wiring := cls.wiring()) as address:
                return client.ask(replace(wiring, address=address), case.seconds)

        with ExitStack() as stack:
            clients = [stack.enter_context(closing(ClientProcess())) for _ in range(AT_ONCE)]
            yield stack.enter_context(_at_once(clients, send, _chosen(request, "hostile_server")))

    def test_the_server_outlives_a_hostile_client(
        self,
        hostile_client: Case[Attack],
        attacked: dict[Case[Attack], Future[Attacked]],
        record_property: Callable[[str, object], None],
    ) -> None:
        outcome = attacked[hostile_client].result()
        record_property("cost", f"{self.name}, server: {outcome.seconds:.2f} s, {outcome.peak_mib:.0f} MiB")
        assert outcome.answer == outcome.expected != []
        assert outcome.alive
        assert re.search(hostile_client.says, outcome.reply, re.DOTALL), outcome.reply[:1000]
        assert outcome.seconds < hostile_client.seconds
        assert outcome.peak_mib < hostile_client.mib
        assert outcome.tidy, "descriptors are left"

    def test_the_client_outlives_a_hostile_server(
        self,
        hostile_server: Case[Trap],
        trapped: dict[Case[Trap], Future[dict[str, Any]]],
        record_property: Callable[[str, object], None],
    ) -> None:
        outcome = trapped[hostile_server].result()
        record_property("cost", f"{self.name}, client: {outcome['seconds']:.2f} s, {outcome['peak_mib']:.0f} MiB")
        error = outcome["error"]
        assert re.search(hostile_server.says, error) if hostile_server.says else not error, error
        assert error.isprintable(), f"not one line of plain text: {error!r}"
        assert outcome["seconds"] < hostile_server.seconds
        assert outcome["peak_mib"] < hostile_server.mib


def _chosen(request: pytest.FixtureRequest, name: str) -> list[Case[Any]]:
    items: list[Any] = request.session.items
    params = [
        item.callspec.params
        for item in items
        if getattr(item, "cls", None) is request.cls and hasattr(item, "callspec")
    ]
    return [each[name] for each in params if name in each]


@contextmanager
def _at_once(
    ends: Sequence[End], run: Callable[[End, Case[Any]], Outcome], cases: Sequence[Case[Any]]
) -> Iterator[dict[Case[Any], Future[Outcome]]]:
    """Run the cases on threads, each with one of our ends alone; yield their outcomes."""
    free: SimpleQueue[End] = SimpleQueue()
    for end in ends:
        free.put(end)

    def meet(case: Case[Any]) -> Outcome:
        end = free.get()
        try:
            return run(end, case)
        finally:
            free.put(end)

    with ThreadPoolExecutor(len(ends)) as pool:
        try:
            yield {case: pool.submit(meet, case) for case in cases}
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def own_server(wiring: Wiring[Any], log: Path, **engine: Any) -> Iterator[OwnServer]:
    """Run a server in a separate process, with the echo engine unless ``engine`` names another."""
    config = EngineConfig(**{"name": STAND_IN, "answer": wiring.capabilities.answer_kinds[0], **engine})
    server = OwnServer("hostile", ServerJob(wiring, config), log)
    with server:
        server.wait_ready()
        yield server


def honest_answer(client: Client) -> list[str]:
    """Return the answer to one short request; while the server is busy it is repeated, for `SETTLES_S`."""
    deadline = now_ns() + round(SETTLES_S * 1e9)
    while True:
        try:
            return [piece.text for piece in ask(client, Request("honest", "go on", max_tokens=3))[0]]
        except RequestFailed as error:
            if error.retry_after_s is None or now_ns() > deadline:
                raise
            SystemClock().sleep_until_ns(now_ns() + round(min(error.retry_after_s, SETTLES_S) * 1e9))


def _settled(met: Callable[[], bool]) -> bool:
    """Return True if a condition holds within `SETTLES_S`."""
    clock, deadline = SystemClock(), now_ns() + round(SETTLES_S * 1e9)
    while not met():
        if now_ns() > deadline:
            return False
        clock.sleep_until_ns(now_ns() + 20_000_000)
    return True
