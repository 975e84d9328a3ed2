"""What a latency run is asked to do."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.harness.plan import LatencyConfig, plan_cells
from s2a_bench.inference import EngineConfig

ADDRESSES = {"http": "http://127.0.0.1:1", "ros": "/s2a_bench", "loopback": "loopback-0"}


def names(config: LatencyConfig) -> list[str]:
    config.check()
    return [cell.name for cell in plan_cells(config, ADDRESSES)]


def test_all_http_variants_and_ros_are_shown_unless_told() -> None:
    assert names(LatencyConfig()) == ["http/as-deployed", "http/best-effort", "http/binary", "ros/topic"]


def test_cells_follow_the_flags() -> None:
    config = LatencyConfig(transports=("loopback", "http"), http=("binary",), payload="raw", connection="per-request")
    loopback, http = plan_cells(config, ADDRESSES)
    assert (loopback.name, loopback.payload) == ("loopback", "")
    assert (http.name, http.payload, http.route.payload) == ("http/binary", "raw", "raw")
    assert http.route.connection == "per-request"


def test_a_foreign_action_is_the_only_ros_cell() -> None:
    config = LatencyConfig(transports=("ros",), ros=("topic", "action"), action="/llama/generate_response")
    (cell,) = plan_cells(config, ADDRESSES)
    assert (cell.name, cell.route.action, cell.route.black_box) == ("ros/action", "/llama/generate_response", True)


def test_both_ros_variants_are_measured_in_one_run() -> None:
    assert names(LatencyConfig(transports=("ros",), ros=("topic", "action"))) == ["ros/topic", "ros/action"]


def test_a_black_box_is_asked_without_the_binary_variant() -> None:
    config = LatencyConfig(url="http://localhost:8080")
    assert names(config) == ["http/as-deployed", "http/best-effort", "ros/topic"]
    assert plan_cells(config, ADDRESSES)[0].route.black_box


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"transports": ("http", "pigeon")}, "--transport: 'pigeon' is none of http, ros, loopback"),
        ({"transports": ()}, "--transport: name at least one of http, ros, loopback"),
        ({"http": ("fast",)}, "--http: 'fast' is none of as-deployed"),
        ({"payload": "gif"}, "--payload: 'gif' is none of jpeg"),
        ({"wire": "rgb"}, "--wire: 'rgb' is none of bgr"),
        ({"connection": "x"}, "--connection: 'x'"),
        ({"mode": "x"}, "--mode: 'x'"),
        ({"dds_tuning": "x"}, "--dds-tuning: 'x'"),
        ({"runs": 0}, "--runs: 0 is not between 1"),
        ({"warmup": -1}, "--warmup: -1"),
        ({"max_tokens": 0}, "--max-tokens: 0"),
        ({"fps": 0.0}, "--fps: 0.0"),
        ({"seed": -1}, "--seed: -1 is not between 0 and 2147483647"),
        ({"max_tokens": 5_000_000_000}, "--max-tokens: 5000000000"),
        ({"timeout_s": float("nan")}, "--timeout: nan"),
        ({"timeout_s": float("inf")}, "--timeout: inf"),
        ({"prompt": "\udcff"}, "--prompt: the text is not valid UTF-8"),
        ({"namespace": "/a b"}, "--namespace: '/a b'"),
        ({"width": 200_000, "height": 200_000}, "--size: 200000x200000"),
        ({"url": "http://[::1"}, "--url: 'http://[::1'"),
        ({"ros": ("service",)}, "--ros: 'service' is none of topic, action"),
        ({"ros": ()}, "--ros: name at least one of topic, action"),
        ({"action": "generate"}, "--action: 'generate' should look like /llama/generate_response"),
        ({"action": "/x", "transports": ("http",)}, "--action needs ros among --transport"),
        ({"action": "/x", "mode": "stream"}, "--action: --mode stream needs our own server"),
        ({"ros": ("action",), "wire": "compressed"}, "--wire compressed: a goal carries sensor_msgs/Image"),
        ({"width": 641}, "--size: 641x480"),
        ({"width": 8, "height": 8}, "--size: 8x8"),
        ({"namespace": "robot"}, "--namespace: 'robot' should look like /name"),
        ({"url": "localhost:1"}, "--url: 'localhost:1' should start with http"),
        ({"url": "http://x", "llama_server": Path("y")}, "--url and --llama-server"),
        ({"url": "http://x", "payload": "raw"}, "--payload raw: with --url a picture travels as jpeg or"),
        ({"url": "http://x", "dialect": "openvla"}, "--payload jpeg: with --dialect openvla a picture travels as raw"),
        ({"url": "http://x", "dialect": "smoke"}, "--dialect: 'smoke' is none of s2a, openai"),
        ({"dialect": "tgi"}, "--dialect is about a server that runs already"),
        ({"llama_server": Path("x"), "extra_body": "{}"}, "--extra-body is about a server that runs already"),
        ({"url": "http://x", "extra_body": "{"}, "--extra-body: no JSON"),
        ({"url": "http://x", "api_key_env": "sk-1"}, "--api-key-env takes the name of an environment variable"),
        ({"url": "http://x", "api_key_env": "NO_SUCH_KEY"}, "--api-key-env: the environment has no such variable"),
        ({"url": "http://u:p@x"}, "--url: leave the password out"),
        ({"url": "http://x", "http": ("binary",)}, "--http binary needs our own server"),
        ({"url": "http://x", "transports": ("ros",)}, "--url needs http among --transport"),
        ({"llama_server": Path("x"), "engine": EngineConfig(name="echo")}, "--llama-server runs a model"),
        ({"mode": "stream", "payload": "jpeg-preencoded"}, "jpeg-preencoded has no meaning in --mode stream"),
    ],
)
def test_what_makes_no_sense_is_named(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        replace(LatencyConfig(), **fields).check()
    assert message in str(error.value)


def test_the_manifest_holds_the_whole_configuration_as_json() -> None:
    config = LatencyConfig(engine=EngineConfig(name="llama", model=Path("m.gguf")))
    kept = json.loads(json.dumps(config.to_manifest(), default=str))
    assert kept["size"] == "640x480"
    assert kept["http"] == ["as-deployed", "best-effort", "binary"]
    assert kept["engine"]["model"] == "m.gguf"
