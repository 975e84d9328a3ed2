"""The run plan of requests: all that follows from a configuration, decided once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from secrets import token_hex
from typing import Any

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import FRAMES_LOST, FRAMES_PUBLISHED, facts_json
from s2a_bench.frames import FrameSource, open_source
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.recording import namespace_of
from s2a_bench.inference import STAND_IN, EngineConfig, need_engine
from s2a_bench.machine.resources import SPENT
from s2a_bench.trace import path_of
from s2a_bench.transport import ACTIONS
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.transport.surroundings import Surroundings

LARGE_PICTURE = 640 * 480
"""Pixels above which UDP needs more receive buffer than Linux gives by default."""


@dataclass(frozen=True, slots=True)
class BlocksPlan:
    """How often every cell is measured, and in which order."""

    requests: int
    warmup: int
    launches: int
    seed: int
    think_s: float = 0.0
    """Least time from a cell's answer to its next request."""


@dataclass(frozen=True, slots=True)
class FeedPlan:
    """The source of pictures, and how a request gets them."""

    source: str
    size: tuple[int, int]
    """Width and height as captured."""
    fps: float
    seed: int
    nonce: str
    stream: bool
    """Whether a camera runs; else every request captures its pictures."""
    cameras: int
    resize: tuple[int, int] | None
    """Width and height as sent; None: as captured."""

    def open(self) -> FrameSource:
        return open_source(self.source, *self.size, fps=self.fps, seed=self.seed)


@dataclass(frozen=True, slots=True)
class RequestPlan:
    """The fields of a request, and those of its row."""

    prompt: str
    grammar: str
    max_pieces: int
    """The most tokens, or actions, of an answer."""
    seed: int
    state: int
    """Length of the robot's state."""
    mode: str
    """The request mode: request or stream."""
    size: str
    stages: Mapping[str, str]
    """Stage -> group of all transports, in the order of the path."""
    surroundings: tuple[Surroundings, ...] = ()


@dataclass(frozen=True, slots=True)
class RunPlan:
    cells: tuple[Pipeline, ...]
    blocks: BlocksPlan
    feed: FeedPlan
    request: RequestPlan
    engine: EngineConfig
    """The engine of all cells; a cell's name may change some of its options."""
    tuned: bool
    """Whether this process and the servers keep large blocks of memory for the next picture."""
    timeout_s: float
    deadline_s: float
    wait_s: float
    """The longest start of an external server."""
    finds_model: bool
    """Whether the model's files are yet to be found."""
    sample_resources_hz: float
    record: Path | None
    namespace: str
    """The namespace of the recorded topics."""
    checks: Mapping[str, str]
    """Code -> the doctor's checks that concern the transports."""
    manifest: Mapping[str, Any]
    """The manifest's entries about the run plan."""

    def with_manifest(self, **facts: Any) -> RunPlan:
        return replace(self, manifest={**self.manifest, **facts})

    def with_cells(self, cells: Sequence[Pipeline]) -> RunPlan:
        every = (*self.cells, *cells)
        stages = path_of(cell.transport.stages for cell in every)
        return replace(self, cells=every, request=replace(self.request, stages=stages)).with_manifest(stages=stages)


def answered(config: RequestsConfig, say: Callable[[str], None]) -> RequestsConfig:
    """Choose the engine if none is named, and ``say`` which if it is not llama."""
    engine = config.engine
    if "name" in engine.model_fields_set or not config.serves_engine:
        return config
    if config.answer == ACTIONS and not engine.of_model:
        say("the echo engine answers with actions; a model's are those of its own server, see `url`")
        return config.but(engine=engine.but(name=STAND_IN))
    if config.starts_program and not extras.installed("llama_cpp"):
        return _without_our_engine(config, say)
    if config.COMPUTES:
        return config
    resolved = config.but(engine=engine.but(name=engine.default_name(say)))
    if left_out := {each.name for each in config.pipelines} - {each.name for each in resolved.pipelines}:
        say(f"{', '.join(sorted(left_out))}: left out, as it needs a model")
    return resolved


def _without_our_engine(config: RequestsConfig, say: Callable[[str], None]) -> RequestsConfig:
    """Keep the cells of external servers, and ``say`` so; raises UsageError if the user named another cell."""
    kept = [each for each in config.pipelines if each.black_box]
    missing = f"our own servers have no engine here; {{}}{extras.how_to_install(*config.engine.kind.needs[:1])}"
    if named := [each.name for each in config.pipelines if each not in kept and _is_named(config, each, kept)]:
        raise UsageError(f"{', '.join(named)}: {missing.format('measure without a model with `engine` echo, or ')}")
    only = [each.name for each in kept]
    say(f"only {', '.join(only)}: {missing.format('')}")
    return config.but(transports=only)


def _is_named(config: RequestsConfig, cell: Pipeline, others: Sequence[Pipeline]) -> bool:
    """Whether the user named a cell, or its transport, of which ``others`` has none."""
    transport, explicit = cell.transport.name, "transports" in config.model_fields_set
    written = {name.partition("?")[0] for name in config.names} if explicit else set()
    named = transport in {*written, *config.options.model_fields_set}
    alone = all(each.transport is not cell.transport for each in others)
    return cell.name.partition("?")[0] in written or (named and alone)


def resolve(config: RequestsConfig, say: Callable[[str], None]) -> RunPlan:
    """Derive the run plan from a configuration, and ``say`` what is chosen; opens and starts nothing.

    Raises MissingExtra if a library that the engine or a server program needs is not installed.
    """
    config = answered(config, say)
    if config.serves_engine:
        need_engine(config.engine)
    if config.starts_program:
        extras.need("model", "gguf")
    cells = tuple(config.pipelines)
    used = {cell.transport.name: cell.transport for cell in cells}.values()
    engine, stream = config.served_engine, config.mode == "stream"
    large = config.size[0] * config.size[1] > LARGE_PICTURE
    stages = path_of(cell.transport.stages for cell in cells)
    facts = [fact for cell in cells for fact in cell.capabilities.facts]
    facts += engine.kind.facts_for(engine) if config.serves_engine else ()
    facts += (FRAMES_PUBLISHED, FRAMES_LOST) if stream else ()
    facts += SPENT if config.sample_resources_hz else ()
    max_pieces = engine.horizon if config.answer == ACTIONS else config.max_tokens
    seed, nonce, size = config.seed, config.nonce or token_hex(8), "{}x{}".format(*config.size)
    return RunPlan(
        cells=cells,
        blocks=BlocksPlan(config.requests, config.warmup, config.launches, seed),
        feed=FeedPlan(config.source, config.size, config.fps, seed, nonce, stream, config.cameras, config.resize),
        request=RequestPlan(
            config.sent_prompt,
            config.grammar,
            max_pieces,
            seed,
            config.state,
            config.mode,
            size,
            stages,
            config.surroundings,
        ),
        engine=engine,
        tuned=config.tuned,
        timeout_s=config.timeout_s,
        deadline_s=config.deadline_s,
        wait_s=config.wait_for_server,
        finds_model=config.reads_model and engine.kind.needs_model,
        sample_resources_hz=config.sample_resources_hz,
        record=config.record,
        namespace=namespace_of(config.options),
        checks={code: each.checks[code] for each in used for code in each.udp_checks if large},
        manifest={
            "configuration": config.to_manifest(),
            "stages": stages,
            "facts": facts_json(facts),
            "seeds": {**dict.fromkeys(("order", "sampling", "source", "bootstrap"), seed), "nonce": nonce},
            "cadence": f"closed loop over an open-loop camera at {config.fps:g} Hz, prompts at random moments"
            if stream
            else "closed loop, the next request when the last is done",
        },
    )
