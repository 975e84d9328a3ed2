"""`s2a-bench serve`: the servers of the harness as long-running programs, for the clients of a robot."""

from __future__ import annotations

import os
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import typer
from pydantic import create_model

from s2a_bench.cli.adapter import command, flags_of
from s2a_bench.cli.ros_args import read as read_ros_args
from s2a_bench.errors import UsageError
from s2a_bench.inference import ANSWERS, OF_MODEL, EngineConfig, acting, check_engine, declared_engine
from s2a_bench.options import Options, group, option, placed, places
from s2a_bench.provenance import Provenance
from s2a_bench.text import none_of
from s2a_bench.toml_file import loads, read
from s2a_bench.transport import ACTIONS, SERVER, SERVING, TRANSPORTS, Transport, Wiring, paths
from s2a_bench.transport.limits import SET, Limits
from s2a_bench.transport.pipeline import Pipeline, answer_over, one_pipeline

if TYPE_CHECKING:
    from s2a_bench.harness.processes import ServerProcess

ENGINE = ("name", *OF_MODEL, "threads", "context", "profile", "gaps", "latency", *ANSWERS)
"""The engine's options of a server; ``gaps`` has no flag, only a key of the file."""
Sorted: TypeAlias = "tuple[dict[str, Any], dict[str, Any], dict[str, Any]]"
_NUMBER = EngineConfig.model_fields["threads"]


def served_options(transport: Transport[Any]) -> list[str]:
    return list(transport.options.of_sides(SERVER, SERVING))


def _as_served(transport: Transport[Any]) -> type[Options]:
    fields: dict[str, Any] = {}
    for name, default in transport.options.SERVE_DEFAULTS.items():
        field = copy(transport.options.model_fields[name])
        field.default = default
        field.description = (field.description or "").partition(" [default")[0]
        fields[name] = (field.annotation, field)
    made: type[Options] = create_model(transport.options.__name__, __base__=transport.options, **fields)
    return made


def _config() -> type[Options]:
    """Make the options of `serve`: the engine's, a group for each transport's server, and the limits."""
    about = "http, ros, or another, as TRANSPORT[/VARIANT][?OPTION=VALUE&...]"
    fields: dict[str, Any] = {
        "pipeline": (str, option(..., about, flag="transport", argument=True, names=paths)),
        "engine": (EngineConfig, group(EngineConfig, only=[name for name in ENGINE if name != "gaps"])),
    }
    for name, each in TRANSPORTS.loaded():
        if names := served_options(each):
            flags = [option for option in names if option not in each.options.NOT_SERVE_FLAGS]
            fields[name] = (_as_served(each), group(_as_served(each), only=flags, about=f"{name}: "))
    fields["limits"] = (Limits, group(Limits, only=SET, about="limit: "))
    fields["config"] = (Path | None, option(None, "TOML file with these flags as keys; a flag wins over it"))
    about = "ros: all arguments up to -- or the end are those of a ROS 2 node: -r, -p, --params-file, --log-level"
    fields["ros_args"] = (str, option("", about))
    return create_model("ServeConfig", __base__=Options, **fields)


def _serve(config: Any) -> None:
    """Serve a pipeline; raises UsageError for an option of another transport."""
    transport = TRANSPORTS[config.pipeline.partition("?")[0].partition("/")[0]]
    if not transport.serves:
        raise UsageError(f"`transport`: {transport.name} is a client alone; start the server of which it is one")
    for other, _ in TRANSPORTS.loaded():
        if stray := sorted(getattr(config, other, Options()).model_fields_set - {*served_options(transport)}):
            raise UsageError(
                f"`{stray[0]}` is not an option of {transport.name}; it has {', '.join(served_options(transport))}"
            )
    flags = getattr(config, transport.name, Options()).given_values()
    where = f"`config` {config.config}"
    of_toml = loads(read(config.config, "config"), where) if config.config else {}
    of_file = _sorted({key.replace("-", "_"): value for key, value in of_toml.items()}, where, transport)
    of_args = _ros_args(config.ros_args, transport, {**of_file[1], **flags})
    of_engine, of_transport, of_limits = (low | high for low, high in zip(of_file, of_args, strict=True))
    limits = Limits(**of_limits | config.limits.given_values())
    pipeline = one_pipeline(config.pipeline, **{**transport.options.SERVE_DEFAULTS, **of_transport, **flags})
    engine = EngineConfig(**of_engine | config.engine.given_values())
    address = next(iter(transport.addresses(pipeline.options)))
    _run(pipeline.wiring(address, limits=limits), _answering(engine, pipeline))


def _answering(engine: EngineConfig, pipeline: Pipeline) -> EngineConfig:
    """Return the engine with its kind of answer set; raises UsageError if it cannot answer so."""
    answer = answer_over(engine.wanted, [pipeline])
    if answer == ACTIONS and not engine.kind.acts:
        raise UsageError(
            f"`engine` {engine.name} answers with tokens, and {pipeline.name} carries actions; use `engine` {acting()}"
        )
    return engine.but(answer=answer)


def _ros_args(text: str, transport: Transport[Any], given: Mapping[str, Any]) -> Sorted:
    if not text:
        return {}, {}, {}
    if "node_name" not in served_options(transport):
        raise UsageError(f"`ros_args` are for ROS 2 nodes, not for serve {transport.name}")
    node = {name: given.get(name, getattr(_as_served(transport)(), name)) for name in ("namespace", "node_name")}
    arguments = read_ros_args(text, _known(transport), node)
    os.environ.update(arguments.environ)
    for note in arguments.notes:
        typer.echo(f"--ros-args: {note}", err=True)
    return _sorted(arguments.options, "`ros_args`", transport)


def _known(transport: Transport[Any]) -> list[str]:
    limits = [flag.name.replace("-", "_") for flag in flags_of(Limits) if flag.path[0] in SET]
    return ["engine", *ENGINE[1:], *served_options(transport), *limits]


def _sorted(values: Mapping[str, Any], where: str, transport: Transport[Any]) -> Sorted:
    """Sort options into those of the engine, of the transport, and limits; raises UsageError naming the key."""
    known = _known(transport)
    for name, value in values.items():
        if name not in known:
            raise UsageError(f"{where}: {none_of(name, known).replace('_', '-')}")
        if isinstance(value, bool) and transport.options.model_fields.get(name, _NUMBER).annotation is not bool:
            raise UsageError(f"{where}: {name} = {value} should be a number or a text")
    of_engine, of_limits = (
        placed(kind, {name: value for name, value in values.items() if name in places(kind)})
        for kind in (EngineConfig, Limits)
    )
    of_transport = {name: value for name, value in values.items() if name in served_options(transport)}
    try:
        EngineConfig(**of_engine)
        transport.options(**of_transport)
        Limits(**of_limits)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error
    return of_engine, of_transport, of_limits


def _run(wiring: Wiring[Any], config: EngineConfig) -> None:
    """Serve until SIGINT or SIGTERM, then exit with 0; a server that died is restarted once."""
    from s2a_bench.harness.processes import keep_serving
    from s2a_bench.harness.serving import ServerJob

    check_engine(config)
    transport = TRANSPORTS[wiring.transport]

    def ready(server: ServerProcess) -> None:
        origin = Provenance.of_engine(server.facts["engine"])
        played = f" of {origin.profile}" if declared_engine(origin.engine).plays else f", {origin.profile}"
        name = f"{origin.engine}{played} (EMULATED)" if origin.emulated else origin.engine
        typer.echo(f"{transport.ready(replace(wiring, address=server.address))}; engine {name}; Ctrl-C ends it")

    job = ServerJob(wiring, config, tuned=transport.tuned(wiring.options), pixels=False)
    keep_serving(job, ready, lambda line: typer.echo(line, err=True))


serve = command(_serve, _config())
