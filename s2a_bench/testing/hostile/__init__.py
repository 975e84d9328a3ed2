"""Hostile peers against both ends of a transport, from tables: subclass `HostileSuite`.

A package that offers a transport over TCP tests it like this, and adds cases that know its messages::

    from s2a_bench.testing.hostile import Case, HostileSuite, tcp

    class TestToy(HostileSuite):
        name = "toy"
        clients = (*tcp.CLIENTS, Case("no JSON", tcp.sends(b"{]"), says="no JSON"))
        servers = tcp.SERVERS

Each case has bounds: on the time until the other side has told its error in one line, and on its memory, both measured.
Most peers are silent most of the time. So several are met at once, each by a process of ours that has nothing else to
do: what is measured of that is one case's.
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
from s2a_bench.testing.hostile.client import TOKENS, forget_peak, usage
from s2a_bench.testing.transport import ask, wiring_of
from s2a_bench.transport import Client, Wiring, open_client
from s2a_bench.transport.limits import PIECES, PIECES_A_TOKEN
from s2a_bench.types import Request

Attack: TypeAlias = "Callable[[Wiring[Any]], str]"
"""A hostile client: is given the wiring of a server that runs, and returns what that said."""
Trap: TypeAlias = "Callable[[Wiring[Any]], AbstractContextManager[str]]"
"""A hostile server: its address, for as long as the context lasts."""
Does = TypeVar("Does")
End = TypeVar("End")
Came = TypeVar("Came")
FAILED = "^(RequestFailed|MessagesLost|ServerDied|TransportError): ."
"""What a client says, where the words are its own affair."""
PATIENCE_S = 2.0
"""The longest silence that the client bears, its ``timeout_s``."""
SETTLES_S = 10.0
AT_ONCE = 6
"""Hostile peers that are met at once."""


@dataclass(frozen=True, slots=True)
class Case(Generic[Does]):
    """One hostile peer: what it does, what the other side says to that, and what it may cost that side."""

    name: str
    does: Does
    says: str = ""
    """A regular expression that is found in what the other side says; a client that says nothing answered."""
    seconds: float = 30.0
    mib: float = 1024.0


class ClientProcess:
    """The process that asks hostile servers; one that hangs is ended, and the next question starts another."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def ask(self, wiring: Wiring[Any], seconds: float) -> dict[str, Any]:
        """Return what came of one request; fails the test after ``seconds``."""
        process = self._process
        if process is None or process.poll() is not None:
            line = [sys.executable, "-c", "from s2a_bench.testing.hostile.client import main; main()"]
            process = self._process = subprocess.Popen(line, stdin=-1, stdout=-1, text=True)  # noqa: S603 - ours
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
        got = process.stdout.readline()
        assert got, f"the client's process ended: {process.wait()}"
        answer: dict[str, Any] = json.loads(got)
        return answer

    def close(self) -> None:
        if self._process is not None:
            with self._process:
                self._process.kill()


@dataclass(frozen=True, slots=True)
class Attacked:
    """What came of a hostile client: what our server said to it, and what an honest client was answered afterwards."""

    said: str
    seconds: float
    peak_mib: float
    answer: list[str]
    expected: list[str]
    """What the honest client was answered before all of them."""
    alive: bool
    tidy: bool
    """Whether no descriptors are left."""


class HostileTarget:
    """Our server in a process of its own, and a client that means well, connected all the while."""

    def __init__(self, wiring: Wiring[Any], server: OwnServer, honest: Client) -> None:
        """Ask a first time: the connection is there from now on."""
        self._told, self._server, self._honest = wiring, server, honest
        self._expected = answer_of(honest)

    def attacked(self, case: Case[Attack]) -> Attacked:
        pid = self._server.pid
        before = usage(pid)
        forget_peak(pid)
        began = now_ns()
        said = case.does(self._told)
        seconds = (now_ns() - began) / 1e9
        answer, peak_mib = answer_of(self._honest), usage(pid).peak_mib
        tidy = _settled(lambda: usage(pid).descriptors <= before.descriptors)
        return Attacked(said, seconds, peak_mib, answer, self._expected, self._server.alive(), tidy)


class HostileSuite:
    """Name the pipeline, and the cases; override `told` for options that a name cannot say."""

    name: ClassVar[str]
    """As in ``--transport``."""
    clients: ClassVar[Sequence[Case[Attack]]] = ()
    servers: ClassVar[Sequence[Case[Trap]]] = ()
    targets: ClassVar[int] = AT_ONCE
    """Servers of ours that hostile clients meet, each one after the other; 1 where their address is told."""

    @classmethod
    def wiring(cls) -> Wiring[Any]:
        """Return what client and server are told."""
        return wiring_of(cls.name, timeout_s=PATIENCE_S, max_tokens=TOKENS)

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Run each test once for each of its cases."""
        for fixture, cases in (("hostile_client", self.clients), ("hostile_server", self.servers)):
            if fixture in metafunc.fixturenames:
                metafunc.parametrize(fixture, cases, ids=[case.name for case in cases])

    @pytest.fixture(scope="class")
    @classmethod
    def attacked(
        cls, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
    ) -> Iterator[dict[Case[Attack], Future[Attacked]]]:
        """What comes of the hostile clients of all tests that were chosen."""
        wiring, folder = cls.wiring(), tmp_path_factory.mktemp("servers")
        with ExitStack() as stack:
            targets: list[HostileTarget] = []
            for number in range(cls.targets):
                server = stack.enter_context(own_server(wiring, folder / f"log-{number}"))
                here = replace(wiring, address=server.address)
                honest = stack.enter_context(closing(open_client(replace(here, timeout_s=60.0))))
                targets.append(HostileTarget(here, server, honest))
            yield stack.enter_context(_at_once(targets, HostileTarget.attacked, _chosen(request, "hostile_client")))

    @pytest.fixture(scope="class")
    @classmethod
    def asked(cls, request: pytest.FixtureRequest) -> Iterator[dict[Case[Trap], Future[dict[str, Any]]]]:
        """What comes of asking the hostile servers of all tests that were chosen."""

        def ask_it(asker: ClientProcess, case: Case[Trap]) -> dict[str, Any]:
            with case.does(wiring := cls.wiring()) as address:
                return asker.ask(replace(wiring, address=address), case.seconds)

        with ExitStack() as stack:
            askers = [stack.enter_context(closing(ClientProcess())) for _ in range(AT_ONCE)]
            yield stack.enter_context(_at_once(askers, ask_it, _chosen(request, "hostile_server")))

    def test_the_server_outlives_a_hostile_client(
        self,
        hostile_client: Case[Attack],
        attacked: dict[Case[Attack], Future[Attacked]],
        record_property: Callable[[str, object], None],
    ) -> None:
        came = attacked[hostile_client].result()
        record_property("cost", f"{self.name}, server: {came.seconds:.2f} s, {came.peak_mib:.0f} MiB")
        assert came.answer == came.expected != []
        assert came.alive
        assert re.search(hostile_client.says, came.said, re.DOTALL), came.said[:1000]
        assert came.seconds < hostile_client.seconds
        assert came.peak_mib < hostile_client.mib
        assert came.tidy, "descriptors are left"

    def test_the_client_outlives_a_hostile_server(
        self,
        hostile_server: Case[Trap],
        asked: dict[Case[Trap], Future[dict[str, Any]]],
        record_property: Callable[[str, object], None],
    ) -> None:
        got = asked[hostile_server].result()
        record_property("cost", f"{self.name}, client: {got['seconds']:.2f} s, {got['peak_mib']:.0f} MiB")
        error = got["error"]
        assert re.search(hostile_server.says, error) if hostile_server.says else not error, error
        assert error.isprintable(), f"not one line of plain text: {error!r}"
        assert got["tokens"] <= PIECES + PIECES_A_TOKEN * TOKENS
        assert got["seconds"] < hostile_server.seconds
        assert got["peak_mib"] < hostile_server.mib


def _chosen(request: pytest.FixtureRequest, name: str) -> list[Case[Any]]:
    """Return the cases of the tests of a class that were chosen."""
    items: list[Any] = request.session.items
    ours = [item for item in items if getattr(item, "cls", None) is request.cls and hasattr(item, "callspec")]
    return [item.callspec.params[name] for item in ours if name in item.callspec.params]


@contextmanager
def _at_once(
    ends: Sequence[End], meets: Callable[[End, Case[Any]], Came], cases: Sequence[Case[Any]]
) -> Iterator[dict[Case[Any], Future[Came]]]:
    """Let ends of ours meet cases on threads, each one at a time; what comes of each is kept for its test."""
    free: SimpleQueue[End] = SimpleQueue()
    for end in ends:
        free.put(end)

    def meet(case: Case[Any]) -> Came:
        end = free.get()
        try:
            return meets(end, case)
        finally:
            free.put(end)

    with ThreadPoolExecutor(len(ends)) as pool:
        try:
            yield {case: pool.submit(meet, case) for case in cases}
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def own_server(wiring: Wiring[Any], log: Path, **engine: Any) -> Iterator[OwnServer]:
    """Run a server in a process of its own, with the echo engine, which may be told more."""
    can = wiring.capabilities.answer_kinds
    config = EngineConfig(**{"name": STAND_IN, "answer": can[0], **engine})
    server = OwnServer("hostile", ServerJob(wiring, config), log)
    with server:
        server.wait_ready()
        yield server


def answer_of(client: Client) -> list[str]:
    """Return what one short question is answered; while it is told to come again it does, for `SETTLES_S`."""
    deadline = now_ns() + round(SETTLES_S * 1e9)
    while True:
        try:
            return [piece.text for piece in ask(client, Request("honest", "go on", max_tokens=3))[0]]
        except RequestFailed as error:
            if error.retry_after_s is None or now_ns() > deadline:
                raise
            SystemClock().sleep_until_ns(now_ns() + round(min(error.retry_after_s, SETTLES_S) * 1e9))


def _settled(met: Callable[[], bool]) -> bool:
    """Whether something comes about within `SETTLES_S`."""
    clock, deadline = SystemClock(), now_ns() + round(SETTLES_S * 1e9)
    while not met():
        if now_ns() > deadline:
            return False
        clock.sleep_until_ns(now_ns() + 20_000_000)
    return True
