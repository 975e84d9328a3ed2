"""The suites that s2a-bench ships, run on what this package adds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from threading import Thread

import pytest
from s2a_toy.engine import ToyWords
from s2a_toy.mode import ToyMode
from s2a_toy.policy import ToyCareful, ToyPolicy
from s2a_toy.source import Stripes
from s2a_toy.transport import TOY, ToyOptions
from s2a_toy.world import SERVER

from s2a_bench.frames import FrameSource
from s2a_bench.inference import Engine, EngineConfig
from s2a_bench.plugins.chunks.modes import Mode
from s2a_bench.plugins.chunks.testing.mode import ModeSuite
from s2a_bench.policy import Policy
from s2a_bench.testing.engine import EngineSuite
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource
from s2a_bench.testing.policy import PolicySuite
from s2a_bench.testing.simulator import SimulatorSuite
from s2a_bench.testing.transport import Connect, TransportSuite
from s2a_bench.transport import Client, Handler, Wiring


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
