"""What a run of requests is asked to do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.harness.plan import RequestsConfig
from s2a_bench.inference import EngineConfig
from s2a_bench.transport import http

URL = {"http": {"url": "http://x"}}


def names(config: RequestsConfig) -> list[str]:
    return [cell.name for cell in config.pipelines]


@pytest.fixture(autouse=True)
def no_llama_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether llama.cpp's own server is on this machine decides nothing here; where it matters, a test says so."""
    monkeypatch.setattr(http, "found_llama_server", lambda: None)


@pytest.mark.parametrize(
    ("asked", "there"),
    [
        ({}, True),
        ({"payload": "jpeg"}, True),
        ({"payload": "raw"}, False),
        ({"engine": EngineConfig(name="echo")}, False),
        ({"options": {"http": {"url": "http://x"}}}, False),
        ({"variants": {"http": ("binary",)}}, False),
    ],
)
def test_llama_cpps_own_server_is_a_cell_where_it_has_the_same_to_do(
    asked: dict[str, Any], there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "found_llama_server", lambda: http.WHEEL)
    config = RequestsConfig(**asked)
    assert ("http/llama-server" in names(config)) is there
    for cell in config.pipelines:
        program = cell.transport.program(cell.options)
        assert (program is not None) is (cell.variant == "llama-server")


def test_a_named_llama_server_adds_its_cell(tmp_path: Path) -> None:
    config = RequestsConfig(options={"http": {"llama_server": tmp_path}})
    assert names(config)[:4] == [f"http/{name}" for name in http.VARIANTS]
    assert [cell.black_box for cell in config.pipelines[:4]] == [False, False, False, True]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "there is none on PATH"),
        ({"engine": EngineConfig(name="echo"), "options": {"http": {"llama_server": "x"}}}, "runs a model"),
        ({"payload": "raw", "options": {"http": {"llama_server": "x"}}}, "travels as jpeg, not raw"),
        ({"options": {"http": {"url": "http://x"}}}, "leave it out with `url`"),
    ],
)
def test_asked_for_by_name_it_is_an_error_where_it_cannot_be(asked: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        RequestsConfig(transports=("http/llama-server",), **asked)


def test_without_our_own_engine_its_cell_is_measured_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "found_llama_server", lambda: http.WHEEL)
    monkeypatch.setattr(extras, "installed", lambda module: module != "llama_cpp")
    said: list[str] = []
    assert names(RequestsConfig().answered(said.append)) == ["http/llama-server"]
    assert said == ["only http/llama-server: our own servers have no engine here; " + extras.how_to_install("llama")]


def test_all_http_variants_and_ros_are_shown_unless_told() -> None:
    assert names(RequestsConfig()) == ["http/as-deployed", "http/best-effort", "http/binary", "ros/topic"]


def test_cells_follow_the_flags() -> None:
    options = {"http": {"connection": "per-request"}}
    config = RequestsConfig(
        transports=("loopback", "http"), variants={"http": ("binary",)}, options=options, payload="raw"
    )
    loopback, http = config.pipelines
    assert (loopback.name, loopback.payload) == ("loopback", "")
    assert (http.name, http.payload) == ("http/binary", "raw")
    assert http.options.connection == "per-request"  # type: ignore[attr-defined]


def test_a_payload_that_is_not_given_is_each_transports_own() -> None:
    assert [cell.payload for cell in RequestsConfig(transports=("http/binary", "ros", "loopback")).pipelines] == [
        "jpeg",
        "raw",
        "",
    ]


def test_a_foreign_action_is_the_only_ros_cell() -> None:
    options = {"ros": {"action": "/llama/generate_response"}}
    config = RequestsConfig(transports="ros", variants={"ros": ("topic", "action")}, options=options)
    (cell,) = config.pipelines
    assert (cell.name, cell.black_box) == ("ros/action", True)
    assert cell.transport.foreign(cell.options) == "/llama/generate_response"


def test_both_ros_variants_are_measured_in_one_run() -> None:
    assert names(RequestsConfig(transports="ros", variants={"ros": "topic,action"})) == ["ros/topic", "ros/action"]


def test_a_black_box_is_asked_without_the_binary_variant() -> None:
    config = RequestsConfig(options={"http": {"url": "http://localhost:8080"}})
    assert names(config) == ["http/as-deployed", "http/best-effort", "ros/topic"]
    assert config.pipelines[0].black_box
    assert config.foreign == "url"


def test_a_black_box_gets_what_its_dialect_takes() -> None:
    config = RequestsConfig(
        transports=("http/as-deployed",), options={"http": {"url": "http://x", "dialect": "openvla"}}
    )
    assert names(config) == ["http/as-deployed"]
    assert config.pipelines[0].payload == "raw"


def test_the_stages_are_those_of_the_transports_in_the_order_of_the_path() -> None:
    assert [*RequestsConfig(transports=("ros",)).stages] == [
        *("capture", "convert", "resize", "image_encode", "cdr_pack", "connect", "network", "accept", "cdr_parse"),
        *("image_decode", "yuv_decode", "channel_swap", "queue", "preprocess", "inference", "server", "return"),
    ]
    assert "cdr_pack" not in RequestsConfig(transports=("http",)).stages


def test_the_facts_are_those_that_transport_dialect_engine_and_harness_may_tell() -> None:
    few: dict[str, Any] = {"engine": EngineConfig(name="echo"), "sample_resources_hz": 0}
    assert RequestsConfig(transports=("loopback",), **few).facts == {}
    few["engine"] = EngineConfig(name="echo", latency="80")
    assert [*RequestsConfig(transports=("loopback",), **few).facts] == ["latency_drawn_ms"]
    few["engine"] = EngineConfig(name="echo")
    over_ros = RequestsConfig(transports=("ros",), mode="stream", **few).facts
    assert {*over_ros} == {
        *("payload_bytes", "camera_frames", "camera_age_ms", "camera_stamp_age_ms", "stale_frames"),
        *("unreadable_n", "frames_published", "frames_lost"),
    }
    assert over_ros["payload_bytes"] == {"unit": "bytes", "about": "what the payload weighs on the wire"}
    ollama = {"http": {"url": "http://x", "dialect": "ollama"}}
    asked = RequestsConfig(transports=("http",), options=ollama, sample_resources_hz=0)
    assert {"reconnects", "load_ms"} < asked.facts.keys()
    assert "prompt_eval_ms" not in asked.facts
    llama = RequestsConfig(transports=("http", "loopback"), engine=EngineConfig(name="llama"))
    assert {"prompt_eval_ms", "energy_j"} < llama.facts.keys()
    assert "load_ms" not in llama.facts


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"transports": ("http", "pigeon")}, "`transport`: 'pigeon' is none of http, ros, loopback"),
        ({"transports": ()}, "`transport`: name at least one of http, ros, loopback"),
        ({"transports": ("http/fast",)}, "`transport`: 'fast' is none of http's as-deployed, best-effort, binary"),
        ({"transports": ("loopback/fast",)}, "`transport`: 'fast' is none of loopback's none: it has no variants"),
        ({"variants": {"http": ("fast",)}}, "`http`: 'fast' is none of http's as-deployed"),
        ({"variants": {"ros": ("service",)}}, "`ros`: 'service' is none of ros's topic, action"),
        ({"payload": "gif"}, "`payload`: 'gif' is none of raw, yuyv, jpeg, jpeg-preencoded, png"),
        ({"payload": "yuyv"}, "`payload`: over http/as-deployed a picture travels as jpeg, jpeg-preencoded, png, raw"),
        ({"payload": "yuyv"}, "http/as-deployed?payload=jpeg"),
        ({"options": {"http": {"connection": "x"}}}, "`connection`: 'x' should be 'keep-alive'"),
        ({"mode": "x"}, "`mode`: 'x'"),
        ({"options": {"ros": {"dds_tuning": "x"}}}, "`dds_tuning`: 'x'"),
        ({"options": {"ros": {"qos": "x"}}}, "`qos`: 'x' should be 'reliable' or 'sensor_data'"),
        ({"options": {"ros": {"middleware": "x"}}}, "`middleware`: 'x' is none of cyclonedds, rclpy"),
        ({"options": {"ros": {"result_timeout": -1}}}, "`result_timeout`: -1 should be greater than or equal to 0"),
        ({"options": {"http": {"port": 70_000}}}, "`port`: 70000 should be less than or equal to 65535"),
        ({"options": {"http": {"port": "many"}}}, "`port`: 'many' should be a valid integer"),
        ({"runs": 0}, "`runs`: 0 should be greater than or equal to 1"),
        ({"warmup": -1}, "`warmup`: -1"),
        ({"max_tokens": 0}, "`max_tokens`: 0"),
        ({"fps": 0.0}, "`fps`: 0.0"),
        ({"seed": -1}, "`seed`: -1 should be greater than or equal to 0"),
        ({"max_tokens": 5_000_000_000}, "`max_tokens`: 5000000000"),
        ({"timeout_s": float("nan")}, "`timeout_s`: nan"),
        ({"timeout_s": float("inf")}, "`timeout_s`: inf"),
        ({"prompt": "\udcff"}, "`prompt`: the text is not valid UTF-8"),
        ({"options": {"ros": {"namespace": "/a b"}}}, "`namespace`: '/a b'"),
        ({"options": {"ros": {"namespace": "robot"}}}, "`namespace`: 'robot' should look like /name"),
        ({"size": (200_000, 200_000)}, "`size`: 200000x200000"),
        ({"size": "641x480"}, "`size`: 641x480"),
        ({"size": (8, 8)}, "`size`: 8x8"),
        ({"options": {"http": {"url": "http://[::1"}}}, "`url`: 'http://[::1'"),
        ({"options": {"http": {"url": "localhost:1"}}}, "`url`: 'localhost:1' should start with http"),
        ({"options": {"ros": {"action": "generate"}}}, "`action`: 'generate' should look like /name"),
        ({"options": {"ros": {"action": "/x"}}, "transports": ("http",)}, "`action` needs ros among `transport`"),
        ({"options": {"ros": {"action": "/x"}}, "transports": ("ros/topic",)}, "`action` is spoken by ros/action"),
        ({"options": {"ros": {"action": "/x"}}, "mode": "stream"}, "`action`: `mode` stream needs our own server"),
        (
            {"variants": {"ros": ("action",)}, "payload": "jpeg"},
            "`payload`: a goal carries sensor_msgs/Image, not jpeg",
        ),
        ({"options": {"http": {"url": "http://x", "llama_server": Path("y")}}}, "`url` and `llama_server`"),
        ({"options": URL, "payload": "raw"}, "a picture travels as jpeg, jpeg-preencoded, png, not raw"),
        ({"options": {"http": {"url": "http://x", "dialect": "openvla"}}, "payload": "jpeg"}, "as raw, not jpeg"),
        ({"options": {"http": {"url": "http://x", "dialect": "smoke"}}}, "`dialect`: 'smoke' is none of s2a, openai"),
        ({"options": {"http": {"dialect": "tgi"}}}, "`dialect` is about a server that runs already"),
        ({"options": {"http": {"llama_server": "x", "extra_body": "{}"}}}, "`extra_body` is about a server that runs"),
        ({"options": {"http": {"url": "http://x", "extra_body": "{"}}}, "`extra_body`: no JSON"),
        ({"options": {"http": {"url": "http://x", "api_key_env": "sk-1"}}}, "`api_key_env` takes the name of an env"),
        ({"options": {"http": {"url": "http://x", "api_key_env": "NO_KEY"}}}, "`api_key_env`: the environment has no"),
        ({"options": {"http": {"url": "http://u:p@x"}}}, "`url`: leave the password out"),
        ({"options": URL, "variants": {"http": ("binary",)}}, "`http`: binary needs our own server"),
        ({"options": URL, "transports": ("ros",)}, "`url` needs http among `transport`"),
        (
            {"options": {"http": {"llama_server": "x"}}, "engine": EngineConfig(name="echo")},
            "`llama_server` runs a model",
        ),
        ({"mode": "stream", "payload": "jpeg-preencoded"}, "jpeg-preencoded has no meaning in `mode` stream"),
    ],
)
def test_what_makes_no_sense_is_named(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        RequestsConfig(**fields)
    assert message in str(error.value)


def test_the_manifest_holds_the_whole_configuration_as_json() -> None:
    config = RequestsConfig(engine=EngineConfig(name="llama", model=Path("m.gguf")))
    kept = json.loads(json.dumps(config.to_manifest(), default=str))
    assert kept["size"] == "640x480"
    assert [*kept["pipelines"]] == ["http/as-deployed", "http/best-effort", "http/binary", "ros/topic"]
    assert kept["pipelines"]["ros/topic"] == {"payload": "raw"}
    assert kept["engine"]["model"] == "m.gguf"
