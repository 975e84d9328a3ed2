"""`s2a-bench serve`: the servers of the harness as long-running programs, for a robot's own clients."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import typer
from pydantic import create_model

from s2a_bench.cli.adapter import command, flags_of
from s2a_bench.cli.ros_args import read as read_ros_args
from s2a_bench.errors import UsageError
from s2a_bench.inference import ACTING, ANSWERS, EngineConfig, acts, check_engine
from s2a_bench.options import Options, group, option, placed, places
from s2a_bench.provenance import Provenance
from s2a_bench.toml_file import loads
from s2a_bench.transport import ACTIONS, TRANSPORTS, Transport, Wiring
from s2a_bench.transport.limits import Limits
from s2a_bench.transport.options import sides
from s2a_bench.transport.pipeline import Pipeline, answer_over, one_pipeline

if TYPE_CHECKING:
    from s2a_bench.harness.processes import ServerProcess

ENGINE = ("name", "model", "mmproj", "threads", "gpu_layers", "context", "profile", "gaps", "latency", *ANSWERS)
"""The engine's options that a server has flags for."""
Sorted: TypeAlias = "tuple[dict[str, Any], dict[str, Any], dict[str, Any]]"
_NUMBER = EngineConfig.model_fields["threads"]


def _told(transport: Transport[Any]) -> list[str]:
    """Return the options that the server of a transport is told."""
    return [name for name, side in sides(transport.options) if side and name not in transport.elsewhere]


def _as_served(transport: Transport[Any]) -> type[Options]:
    """Return a transport's options with the defaults that they have here."""
    fields: dict[str, Any] = {}
    for name, default in transport.serving.items():
        field = copy(transport.options.model_fields[name])
        field.default = default
        field.description = (field.description or "").partition(" [default")[0]
        fields[name] = (field.annotation, field)
    made: type[Options] = create_model(transport.options.__name__, __base__=transport.options, **fields)
    return made


def _config() -> type[Options]:
    """Make the options of `serve`: the engine's, a group of what each transport's server is told, and the limits."""
    fields: dict[str, Any] = {
        "pipeline": (
            str,
            option(
                ..., "http, ros, or another, as TRANSPORT[/VARIANT][?OPTION=VALUE&...]", flag="transport", argument=True
            ),
        ),
        "engine": (EngineConfig, group(EngineConfig, only=ENGINE)),
    }
    for name, each in TRANSPORTS.loaded():
        if told := _told(each):
            fields[name] = (_as_served(each), group(_as_served(each), only=told, about=f"{name}: "))
    fields["limits"] = (Limits, group(Limits, about="limit: "))
    fields["config"] = (Path | None, option(None, "TOML file with these flags as keys; a flag wins over it"))
    fields["ros_args"] = (
        str,
        option(
            "", "ros: what follows, up to -- or the end, as ROS 2 nodes take it: -r, -p, --params-file, --log-level"
        ),
    )
    return create_model("ServeConfig", __base__=Options, **fields)


def _serve(config: Any) -> None:
    """Serve what was asked for; raises UsageError for an option of another transport."""
    chosen = TRANSPORTS[config.pipeline.partition("?")[0].partition("/")[0]]
    own = getattr(config, chosen.name, None)
    for other, _ in TRANSPORTS.loaded():
        if stray := [each for each in getattr(config, other, Options()).given() if each not in _told(chosen)]:
            raise UsageError(f"`{stray[0]}` is no option of {chosen.name}; it has {', '.join(_told(chosen))}")
    flags = {name: getattr(own, name) for name in own.given()} if own else {}
    values = _toml(config.config) if config.config else {}
    of_engine, of_transport, of_limits = _sorted(values, f"`config` {config.config}", chosen)
    for said, into in zip(
        _ros_args(config.ros_args, chosen, {**of_transport, **flags}),
        (of_engine, of_transport, of_limits),
        strict=True,
    ):
        into.update(said)
    engine = {name: getattr(config.engine, name) for name in config.engine.given()}
    limits = Limits(**{**of_limits, **{name: getattr(config.limits, name) for name in config.limits.given()}})
    pipeline = one_pipeline(config.pipeline, **{**chosen.serving, **of_transport, **flags})
    told = EngineConfig(**{**of_engine, **engine})
    _run(pipeline.wiring(chosen.bind(pipeline.options, ()), limits=limits), _answering(told, pipeline))


def _answering(engine: EngineConfig, pipeline: Pipeline) -> EngineConfig:
    """Return the engine, told what to answer with; raises UsageError for one that cannot."""
    answer = answer_over(engine.answer, [pipeline])
    if answer == ACTIONS and not acts(engine.name):
        raise UsageError(
            f"`engine` {engine.name} answers with tokens, and {pipeline.name} carries actions; use `engine` {ACTING}"
        )
    return engine.but(answer=answer)


def _toml(path: Path) -> dict[str, Any]:
    """Read a file of options."""
    try:
        whole = loads(path.read_text(), f"`config` {path}")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"`config`: cannot read {path}: {error}") from error
    return {key.replace("-", "_"): value for key, value in whole.items()}


def _ros_args(text: str, chosen: Transport[Any], given: Mapping[str, Any]) -> Sorted:
    """Read --ros-args, which rename the node that is ``given`` otherwise, and say what is left out."""
    if not text:
        return {}, {}, {}
    if "node_name" not in _told(chosen):
        raise UsageError(f"`ros_args` are for ROS 2 nodes, not for serve {chosen.name}")
    node = {name: given.get(name, getattr(_as_served(chosen)(), name)) for name in ("namespace", "node_name")}
    read = read_ros_args(text, _known(chosen), node)
    for note in read.notes:
        typer.echo(f"--ros-args: {note}", err=True)
    return _sorted(read.options, "`ros_args`", chosen)


def _known(chosen: Transport[Any]) -> list[str]:
    """Return the names of all options of a server, as a file has them."""
    limits = [flag.name.replace("-", "_") for flag in flags_of(Limits)]
    return ["engine", *ENGINE[1:], *_told(chosen), *limits]


def _sorted(values: Mapping[str, Any], where: str, chosen: Transport[Any]) -> Sorted:
    """Return options of the engine, of the transport, and limits; raises UsageError naming the key."""
    known = _known(chosen)
    for name, value in values.items():
        if name not in known:
            raise UsageError(f"{where}: '{name}' is none of {', '.join(known).replace('_', '-')}")
        if isinstance(value, bool) and chosen.options.model_fields.get(name, _NUMBER).annotation is not bool:
            raise UsageError(f"{where}: {name} = {value} should be a number or a text")
    of_engine = placed(EngineConfig, {name: value for name, value in values.items() if name in places(EngineConfig)})
    of_transport = {name: value for name, value in values.items() if name in _told(chosen)}
    of_limits = placed(Limits, {name: value for name, value in values.items() if name in places(Limits)})
    try:
        EngineConfig(**of_engine)
        chosen.options(**of_transport)
        Limits(**of_limits)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error
    return of_engine, of_transport, of_limits


def _run(wiring: Wiring[Any], config: EngineConfig) -> None:
    """Serve until SIGINT or SIGTERM, then end cleanly with exit code 0; a server that died is started again once."""
    from s2a_bench.harness.serving import ServerJob
    from s2a_bench.harness.supervisor import keep_serving

    check_engine(config)
    transport = TRANSPORTS[wiring.transport]

    def ready(server: ServerProcess) -> None:
        origin = Provenance.of_engine(server.facts["engine"])
        played = f" of {origin.profile}" if origin.engine == "replay" else f", {origin.profile}"
        name = f"{origin.engine}{played} (EMULATED)" if origin.emulated else origin.engine
        typer.echo(f"{transport.ready(wiring, server.address)}; engine {name}; Ctrl-C ends it")

    job = ServerJob(wiring, config, tuned=transport.tuned(wiring.options), pixels=False)
    keep_serving(job, ready, lambda line: typer.echo(line, err=True))


serve = command(_serve, _config())
