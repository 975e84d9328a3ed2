"""The options of a run of requests."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from s2a_bench import extras
from s2a_bench.errors import MissingExtra, UsageError
from s2a_bench.experiments.latency.config import LatencyConfig
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import answered
from s2a_bench.inference import EngineConfig, need_engine
from s2a_bench.transport import http
from s2a_bench.transport.ros.joining import namespace_of

PROGRAM = Path(sys.executable)
URL = {"http": {"url": "http://x"}}


def names(config: RequestsConfig) -> list[str]:
    return [cell.name for cell in config.pipelines]


@pytest.fixture(autouse=True)
def no_llama_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether llama.cpp's own server is on this machine decides nothing here; where it matters, a test says so."""
    monkeypatch.setattr(http, "found_llama_server", lambda: None)


@pytest.fixture
def llama_server_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have llama.cpp's own server on this machine, and nothing that our own could run a model with."""
    monkeypatch.setattr(http, "found_llama_server", lambda: http.WHEEL)
    monkeypatch.setattr(extras, "installed", lambda module: module != "llama_cpp")


@pytest.mark.parametrize(
    ("options", "there"),
    [
        ({}, True),
        ({"payload": "jpeg"}, True),
        ({"payload": "raw"}, False),
        ({"payload": "raw,png"}, False),
        ({"engine": EngineConfig(name="echo")}, False),
        ({"options": {"http": {"url": "http://x"}}}, False),
        ({"transports": "http/binary"}, False),
    ],
)
def test_llama_cpps_own_server_is_a_cell_where_it_has_the_same_to_do(
    options: dict[str, Any], there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "found_llama_server", lambda: http.WHEEL)
    config = RequestsConfig(**options)
    assert ("http/llama-server" in names(config)) is there
    for cell in config.pipelines:
        program = cell.transport.program(cell.options)
        assert (program is not None) is (cell.variant == "llama-server")


def test_a_named_llama_server_adds_its_cell() -> None:
    config = RequestsConfig(options={"http": {"llama_server": PROGRAM}})
    assert names(config)[:4] == [f"http/{name}" for name in http.VARIANTS]
    assert [cell.black_box for cell in config.pipelines[:4]] == [False, False, False, True]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "there is none on PATH"),
        ({"engine": EngineConfig(name="echo"), "options": {"http": {"llama_server": PROGRAM}}}, "runs a model"),
        (
            {"payload": "raw", "options": {"http": {"llama_server": PROGRAM}}},
            "can send a picture as jpeg, jpeg-preencoded, not as raw",
        ),
        ({"options": {"http": {"url": "http://x"}}}, "leave it out with `url`"),
    ],
)
def test_named_it_is_an_error_where_it_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        RequestsConfig(transports=("http/llama-server",), **options)


@pytest.mark.usefixtures("llama_server_alone")
def test_without_our_own_engine_its_cell_and_servers_that_run_already_are_measured_alone() -> None:
    lines: list[str] = []
    assert names(answered(RequestsConfig(), lines.append)) == ["http/llama-server"]
    assert lines == ["only http/llama-server: our own servers have no engine here; " + extras.how_to_install("llama")]
    running = RequestsConfig(options={"ros": {"action": "/llama/generate_response"}})
    assert names(answered(running, lines.append)) == ["http/llama-server", "ros/action"]
    config = answered(RequestsConfig(engine={"model": Path("m.gguf")}), lines.append)
    assert (names(config), config.engine.model) == (["http/llama-server"], Path("m.gguf"))


@pytest.mark.usefixtures("llama_server_alone")
@pytest.mark.parametrize(
    "options",
    [
        {"transports": ("http", "ros/topic", "ros/action")},
        {"transports": ("http", "ros")},
        {"transports": ("http/llama-server", "http/as-deployed")},
        {"transports": ("http/llama-server", "http/binary", "ros")},
        {"options": {"ros": {"middleware": "cyclonedds"}}},
    ],
)
def test_without_our_own_engine_what_is_named_is_refused_rather_than_left_out(
    options: dict[str, Any],
) -> None:
    with pytest.raises(UsageError, match=r"no engine here.*`engine` echo.*\[llama\]"):
        answered(RequestsConfig(**options), pytest.fail)


def test_of_two_urls_both_are_asked_or_refused() -> None:
    with pytest.raises(UsageError, match="`url` needs http among `transport`"):
        LatencyConfig(transports="websocket?url=ws://127.0.0.1:1", url="http://127.0.0.1:2")


MODEL = ({"model": Path("m.gguf")}, {"mmproj": Path("p.gguf")}, {"gpu_layers": -1})


@pytest.mark.parametrize("given", MODEL)
def test_a_model_is_never_answered_for_by_another_engine(
    given: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (field,) = given
    monkeypatch.setattr(extras, "installed", lambda module: module != "llama_cpp")
    with pytest.raises(MissingExtra, match=rf"`{field}`.*\[llama\]"):
        need_engine(answered(RequestsConfig(engine=given), pytest.fail).engine)
    with pytest.raises(UsageError, match=f"`{field}`.*leave it out with `engine` echo"):
        RequestsConfig(engine={"name": "echo", **given})
    with pytest.raises(UsageError, match=f"`{field}`.*leave it out with `engine` replay"):
        EngineConfig(name="replay", profile="rtx-4080", **given)
    with pytest.raises(UsageError, match=f"`{field}`.*leave it out with `url`"):
        RequestsConfig(transports="http", engine=given, url="http://127.0.0.1:1")


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({"transports": "http/best-effort"}, "http/llama-server"),
        ({"transports": "ros"}, "http"),
    ],
)
def test_a_llama_server_that_no_cell_runs_is_refused(options: dict[str, Any], wanted: str) -> None:
    with pytest.raises(UsageError, match=f"`llama_server` needs {wanted} among `transport`"):
        RequestsConfig(options={"http": {"llama_server": "x"}}, **options)


def test_all_http_variants_and_ros_are_shown_unless_told() -> None:
    assert names(RequestsConfig()) == ["http/as-deployed", "http/best-effort", "http/binary", "ros/topic"]


def test_cells_follow_the_flags() -> None:
    options = {"http": {"connection": "per-request"}}
    config = RequestsConfig(transports=("loopback", "http/binary"), options=options, payload="raw")
    loopback, http = config.pipelines
    assert (loopback.name, loopback.payload) == ("loopback", "")
    assert (http.name, http.payload) == ("http/binary", "raw")
    assert http.options.connection == "per-request"  # type: ignore[attr-defined]


HTTP_AND_ROS = ["http/binary", "http/binary?payload=jpeg", "ros/topic", "ros/topic?payload=jpeg"]


@pytest.mark.parametrize(
    ("options", "cells"),
    [
        ({}, [*HTTP_AND_ROS, "loopback"]),
        ({"quick": True}, ["http/binary", "ros/topic", "loopback"]),
        ({"mode": "stream"}, ["http/binary", "ros/topic", "loopback"]),
        ({"payload": "raw,jpeg"}, [*HTTP_AND_ROS, "loopback"]),
        ({"payload": "jpeg"}, ["http/binary", "ros/topic", "loopback"]),
        ({"transports": "http/binary?payload=png,ros"}, ["http/binary?payload=png", "ros/topic"]),
        ({"transports": "ros/topic,ros/action"}, [*HTTP_AND_ROS[2:], "ros/action"]),
        ({"transports": "http/as-deployed,ros", "url": "http://x"}, ["http/as-deployed", *HTTP_AND_ROS[2:]]),
    ],
)
def test_a_latency_run_sends_the_same_payloads_over_every_transport(options: dict[str, Any], cells: list[str]) -> None:
    config = LatencyConfig(**{"transports": ("http/binary", "ros", "loopback"), "engine": {"name": "echo"}, **options})
    assert names(config) == cells


@pytest.mark.parametrize(
    ("url", "cells"),
    [
        ("http://x", ["http/as-deployed", "http/best-effort"]),
        ("ws://x", ["websocket/openpi"]),
        ("tcp://x:1", ["zmq/gr00t"]),
    ],
)
def test_a_url_alone_is_asked_over_the_transport_that_its_scheme_names(url: str, cells: list[str]) -> None:
    config = LatencyConfig(url=url)
    assert names(answered(config, pytest.fail)) == cells


def test_what_cannot_carry_the_usual_payload_keeps_its_own() -> None:
    cells = RequestsConfig(transports=("http/as-deployed", "ros", "loopback"), url="http://x").pipelines
    assert [cell.payload for cell in cells] == ["jpeg", "raw", ""]


def test_a_namespace_in_a_url_names_our_server_there() -> None:
    (cell,) = RequestsConfig(url="ros:///robot/llama", clock="ptp").pipelines
    assert (cell.transport.name, cell.variant, cell.options.external_address) == ("ros", "topic", "/robot/llama")
    assert namespace_of(cell.wiring(cell.options.external_address)) == "/robot/llama"


def test_a_foreign_action_is_the_only_ros_cell() -> None:
    options = {"ros": {"action": "/llama/generate_response"}}
    config = RequestsConfig(transports="ros", options=options)
    (cell,) = config.pipelines
    assert (cell.name, cell.black_box) == ("ros/action", True)
    assert cell.options.external_address == "/llama/generate_response"


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


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"transports": ()}, "`transport`: name at least one of http, ros, loopback"),
        ({"transports": ("http/fast",)}, "`transport`: 'fast' is none of http's as-deployed, best-effort, binary"),
        ({"transports": ("loopback/fast",)}, "`transport`: 'fast' is none of loopback's none: it has no variants"),
        ({"transports": "ros/service"}, "`transport`: 'service' is none of ros's topic, action"),
        ({"payload": "yuyv"}, "`payload`: http/as-deployed can send a picture as jpeg, jpeg-preencoded, png, raw"),
        ({"payload": "yuyv"}, "http/as-deployed?payload=jpeg"),
        ({"options": {"http": {"connection": "x"}}}, "`connection`: 'x' should be 'keep-alive'"),
        ({"mode": "x"}, "`mode`: 'x'"),
        ({"options": {"ros": {"dds_tuning": "x"}}}, "`dds_tuning`: 'x'"),
        ({"options": {"ros": {"qos": "x"}}}, "`qos`: 'x' should be 'reliable' or 'sensor_data'"),
        ({"options": {"ros": {"middleware": "x"}}}, "`middleware`: 'x' is none of cyclonedds, rclpy, zenoh"),
        ({"options": {"ros": {"result_timeout": -1}}}, "`result_timeout`: -1 should be greater than or equal to 0"),
        ({"options": {"http": {"port": "many"}}}, "`port`: 'many' should be a valid integer"),
        ({"requests": 0}, "`requests`: 0 should be greater than or equal to 1"),
        ({"warmup": -1}, "`warmup`: -1"),
        ({"max_tokens": 0}, "`max_tokens`: 0"),
        ({"fps": 0.0}, "`fps`: 0.0"),
        ({"seed": -1}, "`seed`: -1 should be greater than or equal to 0"),
        ({"max_tokens": 5_000_000_000}, "`max_tokens`: 5000000000"),
        ({"timeout_s": float("nan")}, "`timeout_s`: nan"),
        ({"timeout_s": float("inf")}, "`timeout_s`: inf"),
        ({"prompt": "\udcff"}, "`prompt`: the text is not valid UTF-8"),
        ({"options": {"ros": {"namespace": "/a b"}}}, "`namespace`: '/a b'"),
        ({"size": (200_000, 200_000)}, "`size`: 200000x200000"),
        ({"size": "641x480"}, "`size`: 641x480"),
        ({"size": (8, 8)}, "`size`: 8x8"),
        ({"options": {"http": {"url": "http://[::1"}}}, "`url`: 'http://[::1'"),
        ({"options": {"http": {"llama_server": "/no/such"}}}, "`llama_server`: /no/such is no program that can be run"),
        (
            {"url": "gopher://x"},
            "`url`: no installed transport speaks gopher://, only http://, https://, ros://, ws://, wss://, tcp://",
        ),
        ({"options": {"http": {"url": "localhost:1"}}}, "`url`: 'localhost:1' should start with http"),
        ({"options": {"ros": {"action": "generate"}}}, "`action`: 'generate' should look like /name"),
        ({"options": {"ros": {"action": "/x"}}, "transports": ("http",)}, "`action` needs ros among `transport`"),
        ({"options": {"ros": {"action": "/x"}}, "transports": ("ros/topic",)}, "`action` is spoken by ros/action"),
        ({"options": {"ros": {"action": "/x"}}, "mode": "stream"}, "`action`: `mode` stream needs our own server"),
        (
            {"transports": "ros/action", "payload": "jpeg"},
            "`payload`: ros/action can send a picture as raw, yuyv, not as jpeg",
        ),
        ({"options": {"http": {"url": "http://x", "llama_server": Path("y")}}}, "`url` and `llama_server`"),
        ({"options": URL, "payload": "raw"}, "can send a picture as jpeg, jpeg-preencoded, png, not as raw"),
        ({"options": {"http": {"url": "http://x", "dialect": "openvla"}}, "payload": "jpeg"}, "as raw, not as jpeg"),
        ({"options": {"http": {"url": "http://x", "dialect": "smoke"}}}, "`dialect`: 'smoke' is none of s2a, openai"),
        ({"options": {"http": {"dialect": "tgi"}}}, "`dialect` is about a server that runs already"),
        ({"options": {"http": {"llama_server": "x", "extra_body": "{}"}}}, "`extra_body` is about a server that runs"),
        ({"options": {"http": {"url": "http://x", "extra_body": "{"}}}, "`extra_body`: no JSON"),
        ({"options": {"http": {"url": "http://x", "api_key_env": "sk-1"}}}, "`api_key_env` takes the name of an env"),
        ({"options": {"http": {"url": "http://x", "api_key_env": "NO_KEY"}}}, "`api_key_env`: the environment has no"),
        ({"options": {"http": {"url": "http://u:p@x"}}}, "`url`: leave the password out"),
        ({"options": URL, "transports": "http/binary"}, "`transport` http/binary needs our own server"),
        (
            {"options": {"http": {"llama_server": PROGRAM}}, "engine": EngineConfig(name="echo")},
            "`llama_server` runs a model",
        ),
        ({"url": "ros://llama"}, "'ros://llama' should look like ros:///llama"),
        ({"options": {"ros": {"url": "ros:///a", "action": "/b"}}}, "`url` and `action` name two servers"),
        ({"clock": "chrony"}, "`clock` is about a server of ours on another host; name it with `url`"),
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
