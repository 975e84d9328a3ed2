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
LLAMA_SERVER = {"http": {"llama_server": PROGRAM}}


def names(config: RequestsConfig) -> list[str]:
    return [cell.name for cell in config.pipelines]


@pytest.fixture(autouse=True)
def no_llama_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether llama.cpp's own server is on this machine decides nothing here; where it matters, a test says so."""
    monkeypatch.setattr(http, "installed_llama_server", lambda: None)


@pytest.fixture
def llama_server_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have llama.cpp's own server on this machine, and nothing that our own could run a model with."""
    monkeypatch.setattr(http, "installed_llama_server", lambda: http.WHEEL)
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
    monkeypatch.setattr(http, "installed_llama_server", lambda: http.WHEEL)
    config = RequestsConfig(**options)
    assert ("http/llama-server" in names(config)) is there
    for cell in config.pipelines:
        program = cell.transport.program(cell.options)
        assert (program is not None) is (cell.variant == "llama-server")


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


def test_options_reach_their_cells() -> None:
    options = {"http": {"connection": "per-request"}}
    (cell,) = RequestsConfig(transports=("http/binary",), options=options).pipelines
    assert cell.options.connection == "per-request"  # type: ignore[attr-defined]
    (cell,) = RequestsConfig(transports="ros", options={"ros": {"action": "/llama/generate"}}).pipelines
    assert cell.options.external_address == "/llama/generate"
    assert RequestsConfig(options=URL).foreign == "url"


OURS = ["http/as-deployed raw", "http/best-effort raw", "http/binary raw", "ros/topic raw"]


@pytest.mark.parametrize(
    ("fields", "cells"),
    [
        ({}, OURS),
        ({"transports": ("loopback", "http/binary"), "payload": "raw"}, ["loopback ", "http/binary raw"]),
        ({"options": LLAMA_SERVER}, [*OURS[:3], "http/llama-server jpeg, foreign", *OURS[3:]]),
        ({"options": URL}, ["http/as-deployed jpeg, foreign", "http/best-effort jpeg, foreign", "ros/topic raw"]),
        (
            {"transports": ("http/as-deployed", "ros", "loopback"), "url": "http://x"},
            ["http/as-deployed jpeg, foreign", "ros/topic raw", "loopback "],
        ),
        (
            {"transports": "http/as-deployed", "options": {"http": {"url": "http://x", "dialect": "openvla"}}},
            ["http/as-deployed raw, foreign"],
        ),
        ({"transports": "ros", "options": {"ros": {"action": "/llama/generate"}}}, ["ros/action raw, foreign"]),
    ],
)
def test_every_cell_sends_what_it_can_to_our_servers_and_foreign_ones(fields: dict[str, Any], cells: list[str]) -> None:
    pipelines = RequestsConfig(**fields).pipelines
    assert [f"{cell.name} {cell.payload}{', foreign' * cell.black_box}" for cell in pipelines] == cells


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


def test_a_namespace_in_a_url_names_our_server_there() -> None:
    (cell,) = RequestsConfig(url="ros:///robot/llama", clock="ptp").pipelines
    assert (cell.transport.name, cell.variant, cell.options.external_address) == ("ros", "topic", "/robot/llama")
    assert namespace_of(cell.wiring(cell.options.external_address)) == "/robot/llama"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"transports": ()}, "`transport`: name at least one of http, ros, loopback"),
        ({"transports": ("http/fast",)}, "`transport`: 'fast' is not one of http's as-deployed, best-effort, binary"),
        ({"transports": ("loopback/fast",)}, "`transport`: 'fast' is not one of loopback's variants: it has none"),
        ({"transports": "http/llama-server"}, "there is none on PATH"),
        (
            {"transports": "http/llama-server", "payload": "raw", "options": LLAMA_SERVER},
            "can send a picture as jpeg, jpeg-preencoded, not as raw",
        ),
        ({"transports": "http/llama-server", "options": URL}, "leave it out with `url`"),
        ({"transports": "http/best-effort", "options": LLAMA_SERVER}, "`llama_server` needs http/llama-server among"),
        ({"transports": "ros", "options": LLAMA_SERVER}, "`llama_server` needs http among `transport`"),
        ({"transports": "ros", "url": "http://x"}, "`url` needs http among"),
        ({"transports": "ros/service"}, "`transport`: 'service' is not one of ros's topic, action"),
        ({"payload": "yuyv"}, "`payload`: http/as-deployed can send a picture as jpeg, jpeg-preencoded, png, raw"),
        ({"payload": "yuyv"}, "http/as-deployed?payload=jpeg"),
        ({"options": {"http": {"connection": "x"}}}, "`connection`: 'x' should be 'keep-alive'"),
        ({"mode": "x"}, "`mode`: 'x'"),
        ({"options": {"ros": {"dds_tuning": "x"}}}, "`dds_tuning`: 'x'"),
        ({"options": {"ros": {"qos": "x"}}}, "`qos`: 'x' should be 'reliable' or 'sensor_data'"),
        ({"options": {"ros": {"middleware": "x"}}}, "`middleware`: 'x' is not one of cyclonedds, rclpy, zenoh"),
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
        ({"options": {"http": {"llama_server": "/no/such"}}}, "`llama_server`: /no/such is not an executable"),
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
        ({"options": {"http": {"url": "http://x", "dialect": "smoke"}}}, "`dialect`: 'smoke' is not one of s2a"),
        ({"options": {"http": {"dialect": "tgi"}}}, "`dialect` is about a server that runs already"),
        ({"options": {"http": {"llama_server": "x", "extra_body": "{}"}}}, "`extra_body` is about a server that runs"),
        ({"options": {"http": {"url": "http://x", "extra_body": "{"}}}, "`extra_body`: not JSON"),
        ({"options": {"http": {"url": "http://x", "api_key_env": "sk-1"}}}, "`api_key_env` takes the name of an env"),
        ({"options": {"http": {"url": "http://x", "api_key_env": "NO_KEY"}}}, "`api_key_env`: the environment has no"),
        ({"options": {"http": {"url": "http://u:p@x"}}}, "`url`: leave the password out"),
        ({"options": URL, "transports": "http/binary"}, "`transport` http/binary needs our own server"),
        ({"options": LLAMA_SERVER, "engine": EngineConfig(name="echo")}, "`llama_server` runs a model"),
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
