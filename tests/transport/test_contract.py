"""Every transport and variant keeps the contract."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from threading import Thread

import pytest

from s2a_bench.testing.transport import Connect, TransportSuite
from s2a_bench.transport import Client, Handler, Route, open_client, open_server


def connector(route: Route) -> Iterator[Connect]:
    """Connect through a server on a thread of its own; everything is stopped afterwards."""
    with ExitStack() as stack:

        def connect(handler: Handler) -> Client:
            server = open_server(route, handler)
            thread = Thread(target=server.serve)
            thread.start()
            stack.callback(thread.join)
            stack.callback(server.stop)
            client = open_client(replace(route, address=server.address, timeout_s=20), thread.is_alive)
            stack.callback(client.close)
            return client

        yield connect


class TestLoopback(TransportSuite):
    @pytest.fixture
    def connect(self) -> Iterator[Connect]:
        yield from connector(Route("loopback"))


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort", "binary"])
@pytest.mark.parametrize("payload", ["raw", "png"])
class TestHttp(TransportSuite):
    @pytest.fixture
    def connect(self, variant: str, payload: str) -> Iterator[Connect]:
        yield from connector(Route("http", variant, payload=payload))


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort", "binary"])
class TestHttpJpeg(TransportSuite):
    lossless = False

    @pytest.fixture
    def connect(self, variant: str) -> Iterator[Connect]:
        yield from connector(Route("http", variant, payload="jpeg"))


@pytest.mark.parametrize("connection", ["per-request", "client-per-request"])
class TestHttpConnections(TransportSuite):
    @pytest.fixture
    def connect(self, connection: str) -> Iterator[Connect]:
        yield from connector(Route("http", "best-effort", payload="raw", connection=connection))


class TestRosTopic(TransportSuite):
    @pytest.fixture
    def connect(self, dds_domain: int) -> Iterator[Connect]:
        yield from connector(Route("ros", "topic", domain_id=dds_domain))


class TestRosAction(TransportSuite):
    carries_id_and_limit = False  # llama_msgs goals have neither

    @pytest.fixture
    def connect(self, dds_domain: int) -> Iterator[Connect]:
        yield from connector(Route("ros", "action", domain_id=dds_domain, max_tokens=2000))
