"""Every transport and variant of the registry keeps the contract, with each of its payloads and connections."""

from __future__ import annotations

from typing import Any, Final

import pytest

from s2a_bench.testing.transport import TransportSuite, wiring_of
from s2a_bench.transport import PAYLOADS, Wiring, paths
from s2a_bench.transport.http import LLAMA_SERVER
from s2a_bench.transport.pipeline import Pipeline, pipelines

ENCODED: Final = [payload for payload in PAYLOADS if payload != "jpeg-preencoded"]
OURS: Final = [
    pipeline
    for pipeline in pipelines(paths(), payloads=ENCODED, strict=False, mode="request")
    if pipeline.transport.serves and pipeline.variant != LLAMA_SERVER  # llama.cpp's own program
]
OF_LLAMA_SERVER, OF_ACTIONS = frozenset({"ingest"}), frozenset({"accept"})
PECULIAR: Final[dict[tuple[str, str], dict[str, Any]]] = {
    ("http", "as-deployed"): {"lacks": OF_LLAMA_SERVER},
    ("http", "best-effort"): {"lacks": OF_LLAMA_SERVER},
    ("http", "binary"): {"lacks": OF_LLAMA_SERVER | {"base64_encode", "base64_decode"}},
    ("ros", "topic"): {"lacks": OF_ACTIONS},
    ("ros", "action"): {"carries_id_and_limit": False},  # llama_msgs goals have neither
    ("websocket", "openpi"): {"whole": True},
    ("zmq", "gr00t"): {"whole": True},
}


@pytest.mark.parametrize("pipeline", OURS, ids=lambda pipeline: f"{pipeline.name}:{pipeline.payload}")
class TestEvery(TransportSuite):
    @pytest.fixture
    def wiring(self, pipeline: Pipeline, dds_domain: int) -> Wiring[Any]:
        vars(self).update(PECULIAR.get((pipeline.transport.name, pipeline.variant), {}))
        options = {"payload": pipeline.payload}
        if "domain_id" in type(pipeline.options).model_fields:
            options["domain_id"] = dds_domain
        return wiring_of(pipeline.name.partition("?")[0], max_tokens=2000, **options)


@pytest.mark.parametrize("connection", ["per-request", "client-per-request"])
class TestHttpConnections(TransportSuite):
    lacks = OF_LLAMA_SERVER

    @pytest.fixture
    def wiring(self, connection: str) -> Wiring[Any]:
        return wiring_of("http/best-effort?payload=raw", connection=connection)


@pytest.mark.parametrize("layout", ["n1.7", "n1.5"])
@pytest.mark.parametrize("payload", ["raw", "png"])
class TestZmqLayouts(TransportSuite):
    whole = True

    @pytest.fixture
    def wiring(self, layout: str, payload: str) -> Wiring[Any]:
        return wiring_of("zmq/gr00t", layout=layout, payload=payload)
