"""The suites that s2a-bench ships, run on what this package adds."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import ExitStack
from socket import create_server
from threading import Thread

import pytest
from s2a_toy.engine import ToyWords
from s2a_toy.mode import ToyMode
from s2a_toy.policy import ToyCareful, ToyPolicy
from s2a_toy.source import Stripes
from s2a_toy.tap import ToyReader
from s2a_toy.transport import TOY, ToyOptions
from s2a_toy.world import SERVER

from s2a_bench.clock import now_ns
from s2a_bench.frames import FrameSource
from s2a_bench.inference import Engine, EngineConfig
from s2a_bench.plugins.chunks.modes import Mode
from s2a_bench.plugins.chunks.testing.mode import ModeSuite
from s2a_bench.plugins.watch.relay import ByteRelay
from s2a_bench.policy import Policy
from s2a_bench.testing.engine import EngineSuite
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource
from s2a_bench.testing.policy import PolicySuite
from s2a_bench.testing.simulator import SimulatorSuite
from s2a_bench.testing.transport import Connect, TransportSuite
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Handler, Wiring
from s2a_bench.transport.tap import Seen
from s2a_bench.types import Request, Token


class TestToyTransport(TransportSuite):
    name = "toy"

    @pytest.fixture
    def connect(self) -> Iterator[Connect]:
        with ExitStack() as stack:

            def connect(handler: Handler) -> Client:
                server = TOY.server(Wiring("toy", "", ToyOptions()), handler)
                thread = Thread(target=server.serve)
                thread.start()
                stack.callback(thread.join)
                stack.callback(server.stop)
                client = TOY.client(Wiring("toy", "", ToyOptions(), server.address), lambda: True)
                stack.callback(client.close)
                return client

            yield connect


def answer(_: Request, trace: Trace) -> Generator[Token, None, None]:
    """Answer with three words."""
    for index, word in enumerate(("turn", "left", "now")):
        trace.token_ns.append(now_ns())
        yield Token(index, word, index)


def test_what_passes_through_a_tap_is_read() -> None:
    told: list[Seen] = []
    server = TOY.server(Wiring("toy", "", ToyOptions()), answer)
    host, _, port = server.address.rpartition(":")
    listener = create_server(("127.0.0.1", 0))
    relay = ByteRelay(listener, (host, int(port)), ToyReader, lambda _, seen: told.append(seen), print)
    threads = [Thread(target=each.serve) for each in (server, relay)]
    for thread in threads:
        thread.start()
    client = TOY.client(Wiring("toy", "", ToyOptions(), f"127.0.0.1:{listener.getsockname()[1]}"), lambda: True)
    for number in range(2):
        assert len([*client.request(Request(str(number), "go", (), 3), Trace())]) == 3
    client.close()
    for each, thread in zip((relay, server), reversed(threads), strict=True):
        each.stop()
        thread.join()
    assert [(seen.what, len(seen.pieces_ns), seen.error) for seen in told] == [("toy", 3, "")] * 2


class TestStripes(FrameSourceSuite):
    @pytest.fixture
    def make_source(self) -> MakeSource:
        def make(width: int, height: int) -> FrameSource:
            return Stripes("", width, height)

        return make


class TestToyPolicies(PolicySuite):
    @pytest.fixture(params=[ToyPolicy(factor=2), ToyCareful(caution=1.0)], ids=lambda policy: policy.name)
    def policy(self, request: pytest.FixtureRequest) -> Policy:
        made: Policy = request.param
        return made


class TestToyMode(ModeSuite):
    @pytest.fixture
    def mode(self) -> Mode:
        return ToyMode(trigger=3)


class TestToyWords(EngineSuite):
    @pytest.fixture
    def engine(self) -> Engine:
        return ToyWords(EngineConfig())

    @pytest.fixture
    def fresh_engine(self) -> Engine:
        return ToyWords(EngineConfig())


class TestToyWorld(SimulatorSuite):
    name = "toy-world"
    DRIVEN = 0.5

    @classmethod
    def outside(cls) -> object:
        return dict(SERVER)
