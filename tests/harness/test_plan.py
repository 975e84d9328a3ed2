"""The plan of a run: what follows from a configuration, decided once."""

from __future__ import annotations

from typing import Any

import pytest

from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.harness.config import DEFAULT_TASK, RequestsConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.inference import EngineConfig


def facts(**given: Any) -> Any:
    return resolve(RequestsConfig(**given), print).manifest["facts"]


@pytest.mark.parametrize(("template", "given"), [("", {}), ("openvla-oft", {}), ("", {"prompt": "open the drawer"})])
def test_a_policy_gets_a_task_not_the_planners_prompt(template: str, given: dict[str, Any]) -> None:
    pytest.importorskip("json_numpy")
    made = {"template": template} if template else {}
    http: Any = {"http": {"url": "http://127.0.0.1:8000", "dialect": "openvla", **made}}
    cameras: dict[str, Any] = {"cameras": 3, "state": 14} if template else {}
    config = LatencyConfig(transports=("http/as-deployed",), options=http, **cameras, **given)
    plan = resolve(config, print)
    assert plan.request.prompt == plan.manifest["configuration"]["prompt"] == given.get("prompt", DEFAULT_TASK)


def test_every_run_has_a_nonce_of_its_own_unless_told() -> None:
    first, second = (resolve(RequestsConfig(), print) for _ in range(2))
    assert first.feed.nonce != second.feed.nonce
    assert first.manifest["seeds"]["nonce"] == first.feed.nonce


def test_the_stages_are_those_of_the_transports_in_the_order_of_the_path() -> None:
    assert [*resolve(RequestsConfig(transports=("ros",)), print).request.stages] == [
        *("capture", "convert", "resize", "image_encode", "cdr_pack", "connect", "network", "accept", "cdr_parse"),
        *("image_decode", "yuv_decode", "channel_swap", "queue", "preprocess", "inference", "server", "return"),
    ]
    assert "cdr_pack" not in resolve(RequestsConfig(transports=("http",)), print).request.stages


def test_the_facts_are_those_that_transport_dialect_engine_and_harness_may_tell() -> None:
    few: dict[str, Any] = {"engine": EngineConfig(name="echo"), "sample_resources_hz": 0}
    assert facts(transports=("loopback",), **few) == {}
    few["engine"] = EngineConfig(name="echo", latency="80")
    assert [*facts(transports=("loopback",), **few)] == ["latency_drawn_ms"]
    few["engine"] = EngineConfig(name="echo")
    over_ros = facts(transports=("ros",), mode="stream", **few)
    assert {*over_ros} == {
        *(
            "payload_bytes",
            "camera_frames",
            "camera_age_ms",
            "camera_stamp_age_ms",
            "camera_sim_age_ms",
            "stale_frames",
        ),
        *("unreadable_n", "frames_published", "frames_lost"),
    }
    assert over_ros["payload_bytes"] == {"unit": "bytes", "about": "what the payload weighs on the wire"}
    ollama = {"http": {"url": "http://x", "dialect": "ollama"}}
    names = facts(transports=("http",), options=ollama, sample_resources_hz=0)
    assert {"reconnects", "load_ms"} < names.keys()
    assert "prompt_eval_ms" not in names
    llama = facts(transports=("http", "loopback"), engine=EngineConfig(name="llama"))
    assert {"prompt_eval_ms", "energy_j"} < llama.keys()
    assert "load_ms" not in llama
