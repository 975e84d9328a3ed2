"""Every transport and variant keeps the contract."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import pytest

from s2a_bench.testing.transport import TransportSuite, wiring_of
from s2a_bench.transport import Wiring


class TestLoopback(TransportSuite):
    name = "loopback"


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort", "binary"])
@pytest.mark.parametrize("payload", ["raw", "png"])
class TestHttp(TransportSuite):
    @pytest.fixture
    def wiring(self, variant: str, payload: str) -> Wiring[Any]:
        return wiring_of(f"http/{variant}", payload=payload)


@pytest.mark.parametrize("variant", ["as-deployed", "best-effort", "binary"])
class TestHttpJpeg(TransportSuite):
    lossless = False

    @pytest.fixture
    def wiring(self, variant: str) -> Wiring[Any]:
        return wiring_of(f"http/{variant}")


@pytest.mark.parametrize("connection", ["per-request", "client-per-request"])
class TestHttpConnections(TransportSuite):
    @pytest.fixture
    def wiring(self, connection: str) -> Wiring[Any]:
        return wiring_of("http/best-effort?payload=raw", connection=connection)


@pytest.mark.parametrize("payload", ["raw", "yuyv", "png"])
class TestRosTopic(TransportSuite):
    @pytest.fixture
    def wiring(self, dds_domain: int, payload: str) -> Wiring[Any]:
        return wiring_of("ros/topic", domain_id=dds_domain, payload=payload)


class TestRosTopicJpeg(TransportSuite):
    lossless = False

    @pytest.fixture
    def wiring(self, dds_domain: int) -> Wiring[Any]:
        return wiring_of("ros/topic?payload=jpeg", domain_id=dds_domain)


class TestRosAction(TransportSuite):
    carries_id_and_limit = False  # llama_msgs goals have neither

    @pytest.fixture
    def wiring(self, dds_domain: int) -> Wiring[Any]:
        return wiring_of("ros/action", domain_id=dds_domain, max_tokens=2000)


@pytest.mark.parametrize("payload", ["raw", "png"])
class TestWebsocket(TransportSuite):
    whole = True

    @pytest.fixture
    def wiring(self, payload: str) -> Wiring[Any]:
        return wiring_of("websocket/openpi", payload=payload)


class TestWebsocketStreamed(TransportSuite):
    name = "websocket/openpi-stream"


class TestWebsocketJpeg(TransportSuite):
    name, lossless, whole = "websocket/openpi?payload=jpeg", False, True


@pytest.mark.parametrize("layout", ["n1.7", "n1.6", "n1.5"])
@pytest.mark.parametrize("payload", ["raw", "png"])
class TestZmq(TransportSuite):
    whole = True

    @pytest.fixture
    def wiring(self, layout: str, payload: str) -> Wiring[Any]:
        return wiring_of("zmq/gr00t", layout=layout, payload=payload)


class TestZmqJpeg(TransportSuite):
    name, lossless, whole = "zmq/gr00t?payload=jpeg", False, True


needs_zenoh = pytest.mark.skipif(not find_spec("zenoh"), reason="the extra zenoh is not installed")


@needs_zenoh
@pytest.mark.parametrize("payload", ["raw", "yuyv", "png"])
class TestRosTopicOverZenoh(TransportSuite):
    @pytest.fixture
    def wiring(self, dds_domain: int, payload: str) -> Wiring[Any]:
        return wiring_of("ros/topic?middleware=zenoh", domain_id=dds_domain, payload=payload)


@needs_zenoh
class TestRosActionOverZenoh(TransportSuite):
    carries_id_and_limit = False

    @pytest.fixture
    def wiring(self, dds_domain: int) -> Wiring[Any]:
        return wiring_of("ros/action?middleware=zenoh", domain_id=dds_domain, max_tokens=2000)
