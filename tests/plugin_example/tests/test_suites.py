"""The suites that s2a-bench ships, run on what this package adds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from threading import Thread

import pytest
from s2a_toy.policy import ToyPolicy
from s2a_toy.source import Stripes
from s2a_toy.transport import TOY, ToyOptions

from s2a_bench.frames import FrameSource
from s2a_bench.policy import Policy
from s2a_bench.testing.frame_source import FrameSourceSuite, MakeSource
from s2a_bench.testing.hostile import HostileSuite, tcp
from s2a_bench.testing.policy import PolicySuite
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


class TestToyPeers(HostileSuite):
    name = "toy"
    clients = tcp.CLIENTS
    servers = tcp.SERVERS


class TestStripes(FrameSourceSuite):
    @pytest.fixture
    def make_source(self) -> MakeSource:
        def make(width: int, height: int) -> FrameSource:
            return Stripes("", width, height)

        return make


class TestToyPolicy(PolicySuite):
    @pytest.fixture
    def policy(self) -> Policy:
        return ToyPolicy(factor=2)
