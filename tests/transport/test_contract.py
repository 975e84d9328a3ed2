"""Every transport and variant of the registry keeps the contract; each payload and connection what concerns it."""

from __future__ import annotations

from typing import Any, Final

import pytest

from s2a_bench.testing.transport import TransportSuite, wiring_of
from s2a_bench.transport import PAYLOADS, Wiring, paths
from s2a_bench.transport.http import LLAMA_SERVER
from s2a_bench.transport.pipeline import Pipeline, pipelines
from tests.suites import only

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


class OfPipeline(TransportSuite):
    @pytest.fixture
    def wiring(self, pipeline: Pipeline, dds_domain: int) -> Wiring[Any]:
        vars(self).update(PECULIAR.get((pipeline.transport.name, pipeline.variant), {}))
        options = {"payload": pipeline.payload}
        if "domain_id" in type(pipeline.options).model_fields:
            options["domain_id"] = dds_domain
        return wiring_of(pipeline.name.partition("?")[0], max_tokens=2000, **options)


PLAIN: Final = [pipeline for pipeline in OURS if "?" not in pipeline.name]
CODED: Final = [pipeline for pipeline in OURS if "?" in pipeline.name]


@pytest.mark.parametrize("pipeline", PLAIN, ids=lambda pipeline: pipeline.name)
class TestEvery(OfPipeline):
    """Each variant, with its default payload."""


@pytest.mark.parametrize("pipeline", CODED, ids=lambda pipeline: pipeline.name)
@only(
    "test_the_picture_arrives_as_rgb",
    "test_several_pictures_and_the_state_reach_the_handler",
    "test_every_stage_takes_time",
    "test_stages_and_residual_sum_to_the_whole",
    "test_the_payload_weighs_as_much_as_its_pictures",
)
class TestEveryPayload(OfPipeline):
    """What a picture's encoding has to do with."""


@pytest.mark.parametrize("connection", ["per-request", "client-per-request"])
@only(
    "test_tokens_arrive_in_order_with_text_and_id",
    "test_every_stage_takes_time",
    "test_an_engine_that_refuses_fails_this_request_only",
    "test_a_request_can_be_left_early",
    "test_closing_twice_does_no_harm",
)
class TestHttpConnections(TransportSuite):
    lacks = OF_LLAMA_SERVER

    @pytest.fixture
    def wiring(self, connection: str) -> Wiring[Any]:
        return wiring_of("http/best-effort?payload=raw", connection=connection)


@pytest.mark.parametrize(("layout", "payload"), [("n1.7", "raw"), ("n1.5", "raw"), ("n1.5", "png")])
@only(
    "test_what_a_server_process_is_told_survives_json",
    "test_actions_arrive_in_order_with_every_bit",
    "test_several_pictures_and_the_state_reach_the_handler",
    "test_every_field_of_a_request_reaches_the_handler",
    "test_the_picture_arrives_as_rgb",
    "test_every_stage_takes_time",
    "test_an_engine_that_refuses_fails_this_request_only",
)
class TestZmqLayouts(TransportSuite):
    whole = True

    @pytest.fixture
    def wiring(self, layout: str, payload: str) -> Wiring[Any]:
        return wiring_of("zmq/gr00t", layout=layout, payload=payload)
