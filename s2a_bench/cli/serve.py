"""`s2a-bench serve`: the servers of the harness as long-running programs, for a robot's own clients."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.cli.options import engine_config
from s2a_bench.errors import UsageError

if TYPE_CHECKING:
    from s2a_bench.inference import EngineConfig
    from s2a_bench.transport import Route

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, add_completion=False)

DEFAULTS: dict[str, Any] = {
    "engine": "llama",
    "model": "",
    "mmproj": "",
    "threads": 0,
    "gpu-layers": 0,
    "context": 4096,
    "profile": "",
    "gaps": "",
    "host": "127.0.0.1",
    "port": 8080,
    "namespace": "/llama",
    "middleware": "",
    "qos": "sensor_data",  # matches reliable cameras as well as best-effort ones
    "dds-tuning": "tuned",
    "feedback-interval": 0.002,
    "max-tokens": 512,
    "result-timeout": 60.0,
}
"""What holds where neither a flag nor the TOML file says otherwise; the file's keys are these."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LEAST = {"threads": 0, "gpu-layers": -1, "context": 256, "port": 0, "max-tokens": 1}
MOST = {"port": 65_535, "max-tokens": 2**20, "result-timeout": 86_400, "feedback-interval": 60}
"""Bounds of the numbers, wherever they come from; seconds are 0 at least."""

Engine = Annotated[str | None, typer.Option(help="llama, echo, replay (a --profile: EMULATED) [default: llama]")]
Model = Annotated[str | None, typer.Option(help="GGUF model [default: the tiny dummy]")]
Mmproj = Annotated[str | None, typer.Option(help="GGUF vision tower that goes with --model")]
Threads = Annotated[int | None, typer.Option(min=0, help="CPU threads of the model; 0: all")]
GpuLayers = Annotated[int | None, typer.Option(min=-1, help="model layers on the GPU; -1: all")]
Context = Annotated[int | None, typer.Option(min=256, help="context length in tokens")]
Profile = Annotated[str | None, typer.Option(help="replay: the board to play, a name of 'profile list' or a path")]
Gaps = Annotated[str | None, typer.Option(help="replay: trace, parametric, constant [default: trace if recorded]")]
Config = Annotated[Path | None, typer.Option(help="TOML file with these flags as keys; a flag wins over it")]


@app.command("http")
def http(
    engine: Engine = None,
    model: Model = None,
    mmproj: Mmproj = None,
    threads: Threads = None,
    gpu_layers: GpuLayers = None,
    context: Context = None,
    profile: Profile = None,
    gaps: Gaps = None,
    host: Annotated[str | None, typer.Option(help="address to bind [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="0: any free one [default: 8080]")] = None,
    config: Config = None,
) -> None:
    """Serve the OpenAI dialect (chat/completions with image data URIs, streamed) until interrupted."""
    from s2a_bench.transport import Route

    given: dict[str, Any] = {"engine": engine, "model": model, "mmproj": mmproj, "threads": threads}
    given |= {"gpu-layers": gpu_layers, "context": context, "profile": profile, "gaps": gaps}
    settings = _settings({**given, "host": host, "port": port}, config)
    route = Route("http", address=f"{settings['host']}:{settings['port']}")
    _run(route, settings, lambda address: f"serving at {address}/v1/chat/completions")


@app.command("ros")
def ros(
    engine: Engine = None,
    model: Model = None,
    mmproj: Mmproj = None,
    threads: Threads = None,
    gpu_layers: GpuLayers = None,
    context: Context = None,
    profile: Profile = None,
    gaps: Gaps = None,
    namespace: Annotated[str | None, typer.Option(help="of the action and the topics [default: /llama]")] = None,
    middleware: Annotated[str | None, typer.Option(help="cyclonedds, rclpy")] = None,
    qos: Annotated[str | None, typer.Option(help="the camera topics': sensor_data, reliable")] = None,
    dds_tuning: Annotated[str | None, typer.Option(help="tuned, default")] = None,
    feedback_interval: Annotated[
        float | None, typer.Option(min=0, help="seconds: faster tokens share a feedback [default: 0.002]")
    ] = None,
    max_tokens: Annotated[int | None, typer.Option(min=1, help="most tokens of a goal [default: 512]")] = None,
    result_timeout: Annotated[float | None, typer.Option(min=0, help="seconds a result is kept [default: 60]")] = None,
    config: Config = None,
) -> None:
    """Serve the action generate_response (llama_msgs) with the camera's newest frame at hand, until interrupted."""
    from s2a_bench.harness.plan import ROS_NAME, TUNINGS
    from s2a_bench.ros.config import domain_id
    from s2a_bench.transport import QOS_PROFILES, Route

    given: dict[str, Any] = {"engine": engine, "model": model, "mmproj": mmproj, "threads": threads}
    given |= {"profile": profile, "gaps": gaps}
    given |= {
        "gpu-layers": gpu_layers,
        "context": context,
        "namespace": namespace,
        "dds-tuning": dds_tuning,
        "max-tokens": max_tokens,
    }
    given |= {"middleware": middleware, "qos": qos, "feedback-interval": feedback_interval}
    settings = _settings({**given, "result-timeout": result_timeout}, config)
    if not ROS_NAME.fullmatch(settings["namespace"]):
        raise UsageError(f"--namespace: '{settings['namespace']}' should look like /name: letters, digits, underscores")
    for key, values in (("dds-tuning", TUNINGS), ("qos", QOS_PROFILES)):
        if settings[key] not in values:
            raise UsageError(f"--{key}: '{settings[key]}' is none of {', '.join(values)}")
    route = Route(
        "ros",
        "action",
        address=settings["namespace"],
        domain_id=domain_id(os.environ),
        middleware=settings["middleware"],
        qos=settings["qos"],
        dds_tuning=settings["dds-tuning"],
        feedback_interval_s=settings["feedback-interval"],
        max_tokens=settings["max-tokens"],
        result_timeout_s=settings["result-timeout"],
        publish_tokens=True,
    )
    _run(
        route,
        settings,
        lambda address: (
            f"serving action {address}/generate_response, camera {address}/camera/image_raw, "
            f"in DDS domain {route.domain_id}"
        ),
    )


def _settings(flags: dict[str, Any], config: Path | None) -> dict[str, Any]:
    """Join defaults, file and flags; raises UsageError for a key or value that the file should not have."""
    from_file = _read(config) if config else {}
    known = {key: value for key, value in DEFAULTS.items() if key in flags}
    for key, value in from_file.items():
        if key not in known:
            raise UsageError(f"--config {config}: '{key}' is none of {', '.join(known)}")
        wanted = (int, float) if isinstance(known[key], float) else type(known[key])
        if not isinstance(value, wanted) or isinstance(value, bool):
            raise UsageError(f"--config {config}: {key} = {value!r} should be like {known[key]!r}")
    settings = known | from_file | {key: value for key, value in flags.items() if value is not None}
    for key, value in settings.items():
        if not isinstance(value, str) and not LEAST.get(key, 0) <= value <= MOST.get(key, 2**31 - 1):
            raise UsageError(f"{key}: {value} is not between {LEAST.get(key, 0)} and {MOST.get(key, 2**31 - 1)}")
    return settings


def _read(path: Path) -> dict[str, Any]:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        return tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--config: cannot read {path}: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"--config: {path} is no TOML: {error}") from error


def _engine(settings: dict[str, Any]) -> EngineConfig:
    from s2a_bench.inference.replay import check_replay

    model, mmproj = (Path(settings[key]) if settings[key] else None for key in ("model", "mmproj"))
    engine = engine_config(
        name=settings["engine"],
        model=model,
        mmproj=mmproj,
        threads=settings["threads"],
        gpu_layers=settings["gpu-layers"],
        context=settings["context"],
        profile=settings["profile"],
        gaps=settings["gaps"],
    )
    check_replay(engine)
    return engine


def _run(route: Route, settings: dict[str, Any], ready: Callable[[str], str]) -> None:
    """Serve until SIGINT or SIGTERM, then end cleanly with exit code 0."""
    from s2a_bench.harness.serving import engine_handler
    from s2a_bench.inference import open_engine
    from s2a_bench.machine.tuning import keep_large_blocks, limit_threads
    from s2a_bench.transport import open_server

    limit_threads()
    if settings.get("dds-tuning", "tuned") == "tuned":
        keep_large_blocks()
    engine = open_engine(_engine(settings))
    try:
        server = open_server(route, engine_handler(engine))

        def stop(*_: Any) -> None:
            for number in SIGNALS:  # a second one does not wait for the answer under way
                signal.signal(number, signal.default_int_handler)
            Thread(target=server.stop).start()  # not here: the signal may have interrupted a lock's holder

        for number in SIGNALS:
            signal.signal(number, stop)
        facts = engine.describe()
        name = f"replay of {facts['profile']} (EMULATED)" if facts.get("emulated") else facts["engine"]
        typer.echo(f"{ready(server.address)}; engine {name}; Ctrl-C ends it")
        server.serve()
    finally:
        engine.close()
