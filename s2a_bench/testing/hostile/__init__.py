"""One hostile peer after the other against both ends of a transport, from tables: subclass `HostileSuite`.

A package that offers a transport over TCP tests it like this, and adds cases that know its messages::

    from s2a_bench.testing.hostile import Case, HostileSuite, tcp

    class TestToy(HostileSuite):
        name = "toy"
        clients = (*tcp.CLIENTS, Case("no JSON", tcp.sends(b"{]"), says="no JSON"))
        servers = tcp.SERVERS

Each case has bounds: on the time until the other side has told its error in one line, and on its memory, both measured.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from selectors import EVENT_READ, DefaultSelector
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import pytest

from s2a_bench.clock import SystemClock, now_ns
from s2a_bench.harness.processes import OwnServer
from s2a_bench.harness.serving import ServerJob
from s2a_bench.inference import EngineConfig
from s2a_bench.testing.hostile.asker import TOKENS
from s2a_bench.testing.hostile.usage import forget_peak, usage
from s2a_bench.testing.transport import ask, wiring
from s2a_bench.transport import TRANSPORTS, Client, Wiring, open_client
from s2a_bench.transport.bounds import PIECES, PIECES_A_TOKEN
from s2a_bench.types import Request

Attack: TypeAlias = "Callable[[Wiring[Any]], str]"
"""A hostile client: is given the wiring of a server that runs, and returns what that said."""
Trap: TypeAlias = "Callable[[Wiring[Any]], AbstractContextManager[str]]"
"""A hostile server: its address, for as long as the context lasts."""
Does = TypeVar("Does")
FAILED = "^(RequestFailed|MessagesLost|ServerDied|TransportError): ."
"""What a client says, where the words are its own affair."""
PATIENCE_S = 2.0
"""The longest silence that the client bears, its ``timeout_s``."""
SETTLES_S = 10.0


@dataclass(frozen=True, slots=True)
class Case(Generic[Does]):
    """One hostile peer: what it does, what the other side says to that, and what it may cost that side."""

    name: str
    does: Does
    says: str = ""
    """A regular expression that is found in what the other side says; a client that says nothing answered."""
    seconds: float = 30.0
    mib: float = 1024.0


class Asker:
    """The process that asks hostile servers; one that hangs is ended, and the next question starts another."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self._process: subprocess.Popen[str] | None = None

    def ask(self, told: Wiring[Any], seconds: float) -> dict[str, Any]:
        """Return what came of one request; fails the test after ``seconds``."""
        process = self._process
        if process is None or process.poll() is not None:
            line = [sys.executable, "-m", "s2a_bench.testing.hostile.asker"]
            process = self._process = subprocess.Popen(line, stdin=-1, stdout=-1, text=True)  # noqa: S603 - ours
        assert process.stdin
        assert process.stdout
        process.stdin.write(json.dumps(told.to_json()) + "\n")
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
        """End the process."""
        if self._process is not None:
            with self._process:
                self._process.kill()


class HostileSuite:
    """Name the pipeline, and the cases; override `told` for options that a name cannot say."""

    name: ClassVar[str]
    """As in ``--transport``."""
    clients: ClassVar[Sequence[Case[Attack]]] = ()
    servers: ClassVar[Sequence[Case[Trap]]] = ()
    expected: ClassVar[list[str]]
    """What an honest client is answered."""

    @classmethod
    def told(cls) -> Wiring[Any]:
        """Return what client and server are told."""
        return wiring(cls.name, timeout_s=PATIENCE_S, max_tokens=TOKENS)

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Run each test once for each of its cases."""
        for fixture, cases in (("hostile_client", self.clients), ("hostile_server", self.servers)):
            if fixture in metafunc.fixturenames:
                metafunc.parametrize(fixture, cases, ids=[case.name for case in cases])

    @pytest.fixture(scope="class")
    @classmethod
    def server(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OwnServer]:
        """Our server in a process of its own, one for all hostile clients."""
        with own_server(cls.told(), tmp_path_factory.mktemp("server") / "log") as process:
            yield process

    @pytest.fixture(scope="class")
    @classmethod
    def honest(cls, server: OwnServer) -> Iterator[Client]:
        """A client that means well."""
        with closing(open_client(replace(cls.told(), address=server.address, timeout_s=60.0))) as client:
            cls.expected = _answer(client)  # its connection is there from now on
            assert cls.expected
            yield client

    @pytest.fixture(scope="class")
    @classmethod
    def asker(cls) -> Iterator[Asker]:
        """The process that asks hostile servers."""
        with closing(Asker()) as process:
            yield process

    def test_the_server_outlives_a_hostile_client(
        self,
        hostile_client: Case[Attack],
        server: OwnServer,
        honest: Client,
        record_property: Callable[[str, object], None],
    ) -> None:
        before = usage(server.pid)
        forget_peak(server.pid)
        began = now_ns()
        said = hostile_client.does(replace(self.told(), address=server.address))
        seconds = (now_ns() - began) / 1e9
        answer = _answer(honest)
        peak = usage(server.pid).peak_mib
        record_property("cost", f"{self.name}, server: {seconds:.2f} s, {peak:.0f} MiB")
        assert answer == self.expected
        assert server.alive()
        assert re.search(hostile_client.says, said, re.DOTALL), said[:1000]
        assert seconds < hostile_client.seconds
        assert peak < hostile_client.mib
        assert _settled(lambda: usage(server.pid).descriptors <= before.descriptors), "descriptors are left"

    def test_the_client_outlives_a_hostile_server(
        self, hostile_server: Case[Trap], asker: Asker, record_property: Callable[[str, object], None]
    ) -> None:
        with hostile_server.does(self.told()) as address:
            got = asker.ask(replace(self.told(), address=address), hostile_server.seconds)
        record_property("cost", f"{self.name}, client: {got['seconds']:.2f} s, {got['peak_mib']:.0f} MiB")
        error = got["error"]
        assert re.search(hostile_server.says, error) if hostile_server.says else not error, error
        assert error.isprintable(), f"not one line of plain text: {error!r}"
        assert got["tokens"] <= PIECES + PIECES_A_TOKEN * TOKENS
        assert got["seconds"] < hostile_server.seconds
        assert got["peak_mib"] < hostile_server.mib


@contextmanager
def own_server(told: Wiring[Any], log: Path, **engine: Any) -> Iterator[OwnServer]:
    """Run a server in a process of its own, with the echo engine, which may be told more."""
    can = TRANSPORTS[told.transport].answers(told.variant, told.options)
    config = EngineConfig(**{"name": "echo", "answer": can[0], **engine})
    server = OwnServer("hostile", ServerJob(told, config), log)
    with server:
        server.wait_ready()
        yield server


def _answer(client: Client) -> list[str]:
    """Return what one short question is answered."""
    return [piece.text for piece in ask(client, Request("honest", "go on", max_tokens=3))[0]]


def _settled(met: Callable[[], bool]) -> bool:
    """Whether something comes about within `SETTLES_S`."""
    clock, deadline = SystemClock(), now_ns() + round(SETTLES_S * 1e9)
    while not met():
        if now_ns() > deadline:
            return False
        clock.sleep_until_ns(now_ns() + 20_000_000)
    return True
