"""`s2a-bench serve`: the servers of the harness as long-running programs, for a robot's own clients."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from s2a_bench.cli.options import engine_config
from s2a_bench.errors import UsageError

if TYPE_CHECKING:
    from s2a_bench.inference import EngineConfig
    from s2a_bench.transport import Wiring

ENGINE: dict[str, Any] = {
    "engine": "llama",
    "model": "",
    "mmproj": "",
    "threads": 0,
    "gpu_layers": 0,
    "context": 4096,
    "profile": "",
    "gaps": "",
}
"""What holds of the engine where neither a flag nor the TOML file says otherwise."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LEAST = {"gpu_layers": -1, "context": 256}


def serve(
    transport: Annotated[str, typer.Argument(help="http, ros, or another, as TRANSPORT[/VARIANT][?OPTION=VALUE&...]")],
    engine: Annotated[
        str | None, typer.Option(help="llama, echo, replay (a --profile: EMULATED) [default: llama]")
    ] = None,
    model: Annotated[str | None, typer.Option(help="GGUF model [default: the tiny dummy]")] = None,
    mmproj: Annotated[str | None, typer.Option(help="GGUF vision tower that goes with --model")] = None,
    threads: Annotated[int | None, typer.Option(min=0, help="CPU threads of the model; 0: all")] = None,
    gpu_layers: Annotated[int | None, typer.Option(min=-1, help="model layers on the GPU; -1: all")] = None,
    context: Annotated[int | None, typer.Option(min=256, help="context length in tokens")] = None,
    profile: Annotated[
        str | None, typer.Option(help="replay: the board to play, a name of 'profile list' or a path")
    ] = None,
    gaps: Annotated[
        str | None, typer.Option(help="replay: trace, parametric, constant [default: trace if recorded]")
    ] = None,
    host: Annotated[str | None, typer.Option(help="http: address to bind [default: 127.0.0.1]")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="http: port; 0: any free one [default: 8080]")
    ] = None,
    namespace: Annotated[str | None, typer.Option(help="ros: of the action and the topics [default: /llama]")] = None,
    middleware: Annotated[str | None, typer.Option(help="ros: cyclonedds, rclpy")] = None,
    qos: Annotated[str | None, typer.Option(help="ros: the camera topics': sensor_data, reliable")] = None,
    dds_tuning: Annotated[str | None, typer.Option(help="ros: tuned, default")] = None,
    feedback_interval: Annotated[
        float | None, typer.Option(min=0, help="ros: seconds; faster tokens share a feedback [default: 0.002]")
    ] = None,
    max_tokens: Annotated[int | None, typer.Option(min=1, help="ros: most tokens of a goal [default: 512]")] = None,
    result_timeout: Annotated[
        float | None, typer.Option(min=0, help="ros: seconds a result is kept [default: 60]")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file with these flags as keys; a flag wins over it")] = None,
) -> None:
    """Serve a model until interrupted: over HTTP (OpenAI's dialect), as a ROS 2 node, or over another transport."""
    flags = {name: value for name, value in locals().items() if name not in {"transport", "config"}}
    from s2a_bench.transport import TRANSPORTS
    from s2a_bench.transport.pipeline import one_pipeline

    given = {name: value for name, value in flags.items() if value is not None}
    chosen = TRANSPORTS[transport.partition("?")[0].partition("/")[0]]
    known = [*ENGINE, *(name for name in chosen.options.model_fields if name != "payload")]
    for name in given.keys() - {*known}:
        raise UsageError(f"`{name}` is no option of {chosen.name}; it has {', '.join(known)}")
    from_file = _read(config, known) if config else {}
    settings = {**ENGINE, **chosen.serving, **from_file, **given}
    pipeline = one_pipeline(transport, **{name: value for name, value in settings.items() if name not in ENGINE})
    _run(pipeline.wiring(chosen.bind(pipeline.options, ())), _engine(settings))


def _read(path: Path, known: list[str]) -> dict[str, Any]:
    """Read the file; raises UsageError for a key that it should not have, or for an engine's value of another kind."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        whole = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--config: cannot read {path}: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"--config: {path} is no TOML: {error}") from error
    for key, value in whole.items():
        name = key.replace("-", "_")
        if name not in known:
            raise UsageError(f"--config {path}: '{key}' is none of {', '.join(known).replace('_', '-')}")
        if name in ENGINE and (not isinstance(value, type(ENGINE[name])) or isinstance(value, bool)):
            raise UsageError(f"--config {path}: {key} = {value!r} should be like {ENGINE[name]!r}")
    return {key.replace("-", "_"): value for key, value in whole.items()}


def _engine(settings: dict[str, Any]) -> EngineConfig:
    """Make the engine's configuration; raises UsageError."""
    from s2a_bench.inference.replay import check_replay

    for name in ("threads", "gpu_layers", "context"):
        if settings[name] < LEAST.get(name, 0):
            raise UsageError(f"`{name}`: {settings[name]} is below {LEAST.get(name, 0)}")
    model, mmproj = (Path(settings[key]) if settings[key] else None for key in ("model", "mmproj"))
    engine = engine_config(
        name=settings["engine"],
        model=model,
        mmproj=mmproj,
        threads=settings["threads"],
        gpu_layers=settings["gpu_layers"],
        context=settings["context"],
        profile=settings["profile"],
        gaps=settings["gaps"],
    )
    check_replay(engine)
    return engine


def _run(wiring: Wiring[Any], config: EngineConfig) -> None:
    """Serve until SIGINT or SIGTERM, then end cleanly with exit code 0."""
    from s2a_bench.harness.serving import engine_handler
    from s2a_bench.inference import open_engine
    from s2a_bench.machine.tuning import keep_large_blocks, limit_threads
    from s2a_bench.transport import TRANSPORTS, open_server

    limit_threads()
    if TRANSPORTS[wiring.transport].tuned(wiring.options):
        keep_large_blocks()
    engine = open_engine(config)
    try:
        server = open_server(wiring, engine_handler(engine, pixels=False))

        def stop(*_: Any) -> None:
            for number in SIGNALS:  # a second one does not wait for the answer under way
                signal.signal(number, signal.default_int_handler)
            Thread(target=server.stop).start()  # not here: the signal may have interrupted a lock's holder

        for number in SIGNALS:
            signal.signal(number, stop)
        facts = engine.describe()
        name = f"replay of {facts['profile']} (EMULATED)" if facts.get("emulated") else facts["engine"]
        said = TRANSPORTS[wiring.transport].ready(wiring, server.address)
        typer.echo(f"{said}; engine {name}; Ctrl-C ends it")
        server.serve()
    finally:
        engine.close()
