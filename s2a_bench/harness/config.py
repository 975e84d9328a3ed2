"""The options of a run of requests, their checks, and the pipelines that follow from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, TypeAlias

from pydantic import create_model

from s2a_bench.errors import UsageError
from s2a_bench.frames import SOURCES
from s2a_bench.inference import EngineConfig, acting, check_engine, computing
from s2a_bench.options import Grammar, Names, Options, Size, Square, TextOrFile, group, option
from s2a_bench.transport import (
    ACTIONS,
    EXTERNAL,
    PAYLOADS,
    PROGRAM,
    RAW,
    SERVER,
    TRANSPORT,
    TRANSPORTS,
    Choice,
    Payloads,
    named_by,
    paths,
)
from s2a_bench.transport.defaults import COMPARED
from s2a_bench.transport.pipeline import Pipeline, answer_over, carries_alone, pipelines, require_payload
from s2a_bench.transport.surroundings import SURROUNDINGS, Surroundings

LARGEST = 16_384

DEFAULT_PROMPT = """You are a robot task planner.
Skills: go_to(location), open(object), close(object), pick(object), place(object, location).
Rules: Output only numbered skill calls, one per line.
Do not output any explanation."""
"""The paper's prompt (section IV-E)."""
DEFAULT_TASK = "pick up the red block and place it in the box"
"""The prompt of policies, which answer with actions."""

if TYPE_CHECKING:
    TransportOptions: TypeAlias = Options
else:  # a group of options for each transport; options that only `serve` has get no flag
    TransportOptions = create_model(
        "PerTransport",
        __base__=Options,
        **{
            name: (each.options, group(each.options, only=each.options.of_sides("", SERVER, EXTERNAL, PROGRAM)))
            for name, each in TRANSPORTS.loaded()
        },
    )


class SentConfig(Options):
    PANEL: ClassVar[str] = "Pictures"

    transports: Names = option(
        COMPARED,
        f"{', '.join(dict(TRANSPORTS.loaded()))}; several with commas, with /VARIANT and ?OPTION=VALUE: "
        "ros/topic?payload=yuyv",
        flag="transport",
        panel=TRANSPORT,
        first=True,
        names=paths,
    )
    source: str = option("synthetic", f"{', '.join(SOURCES)}, as video:FILE", names=lambda: SOURCES)
    size: Size = option((640, 480), "WIDTHxHEIGHT of the frames [default: 640x480]", first=True)
    cameras: int = option(1, "pictures a request, read one after the other from the source", ge=1, le=16)
    resize: Square | None = option(
        None, "WIDTHxHEIGHT, or 224 for 224x224: pictures are scaled to it before they are sent [default: as captured]"
    )
    state: int = option(0, "numbers (float32) of the robot's state that go with a request", ge=0, le=4096)
    payload: Payloads = option(
        (),
        f"how pictures are sent: {', '.join(PAYLOADS)}; several with commas, each in cells of its own [default: raw]",
        first=True,
    )
    options: TransportOptions = group(TransportOptions, first=())
    """The options of every transport, for names that do not set them."""
    url: str = option(
        "",
        "a server that runs already (a black box), of the transport that its scheme names: "
        f"{', '.join(f'{scheme}://' for _, each in TRANSPORTS.loaded() for scheme in each.urls.schemes)}",
        panel=TRANSPORT,
        first=True,
    )


AROUND: Final = tuple(name for _, each in SURROUNDINGS.loaded() for name in each.options.model_fields)
"""The fields of what may surround a run."""

if TYPE_CHECKING:
    Surrounded: TypeAlias = SentConfig
else:  # with the options of everything that may surround a run
    SURROUNDING = dict.fromkeys(each.options for _, each in SURROUNDINGS.loaded())
    Surrounded = create_model("Surrounded", __base__=(*reversed(SURROUNDING), SentConfig))


GROUPED: Final = (
    *("transports", "options", "url", "engine", "payload", "source", "size", "cameras", "resize", "state"),
    *("warmup", "timeout_s", "wait_for_server", "deadline_s", "sample_resources_hz", "nonce"),
)
"""The fields of requests that are flags where requests are one group of an experiment's options."""


def sampling(hz: float) -> Any:
    """Declare the option of readings beside a run, with its default rate."""
    about = "readings a second of CPU, memory, GPU and power beside the run; 0: none"
    return option(hz, about, flag="sample-resources", ge=0, le=1000)


class RequestsConfig(Surrounded):
    PANEL: ClassVar[str] = "Requests"
    QUICK: ClassVar[dict[str, int]] = {"requests": 10, "warmup": 2, "max_tokens": 8}
    """The defaults under ``quick``."""
    COUNTS_TOKENS: ClassVar[str] = "this command counts tokens"
    """Why the command refuses answers of actions; empty: it accepts them."""
    COMPUTES: ClassVar[str] = ""
    """Why the command refuses engines that compute nothing; empty: it accepts them."""
    EVERY_VARIANT: ClassVar[bool] = True
    """Whether a transport named without a variant stands for all its default variants; else for its first."""
    OF_ENGINE: ClassVar[tuple[str, ...]] = ()
    """The engine's options that names of pipelines may set, so that cells of one run have different engines."""

    engine: EngineConfig = group(EngineConfig)
    requests: int = option(50, "requests a pipeline [default: 50, quick: 10]", ge=1, le=10**9, first=True)
    warmup: int = option(5, "warm-ups a pipeline, kept and marked [default: 5, quick: 2]", ge=0, le=10**9)
    launches: int = option(1, "fresh sets of servers, --requests each; ratios then hold beyond one", ge=1, le=1000)
    mode: Literal["request", "stream"] = option("request", "request (a frame each), stream (a camera runs)")
    fps: float = option(30.0, "rate of the camera in --mode stream", ge=0.1, le=1000)
    max_tokens: int = option(32, "tokens an answer [default: 32, quick: 8]", ge=1, le=2**20)
    prompt: TextOrFile = option(DEFAULT_PROMPT, "text, or @FILE [default: the paper's prompt; of policies, a task]")
    grammar: Grammar = option("", "GBNF file that every answer obeys")
    seed: int = option(0, "seed of the order, the source and the sampling", ge=0, le=2**31 - 1)
    nonce: str = option(
        "",
        "nonce of another run, to send its very pictures again [default: a new one]",
        pattern="^[0-9A-Za-z_-]{0,64}$",
    )
    timeout_s: float = option(300.0, "longest silence of a server, in seconds", flag="timeout", ge=0.1, le=86_400)
    wait_for_server: float = option(0.0, "seconds that the server of --url may take to start", ge=0, le=86_400)
    deadline_s: float = option(
        0.0,
        "longest time of a whole answer, in seconds; 0: --timeout and 5 s a token",
        flag="deadline",
        ge=0,
        le=86_400,
    )
    sample_resources_hz: float = sampling(10.0)
    record: Path | None = option(None, "also record frames, requests and tokens, as run.mcap (rosbag2)")
    quick: bool = option(False, "fewer samples: a first look", first=True)

    def __init__(self, **arguments: Any) -> None:
        """Apply the defaults of ``quick``; ``url`` sets the option of the transport that its scheme names.

        Raises UsageError naming the field.
        """
        arguments = {**self.QUICK, **arguments} if arguments.get("quick") else arguments
        if url := arguments.get("url"):
            name, groups = named_by(url), dict(arguments.get("options") or {})
            values = groups.get(name, {})
            values = values.given_values() if isinstance(values, Options) else values
            arguments["options"] = {**groups, name: {**values, "url": url}}
            arguments.setdefault("transports", (name,))
        super().__init__(**arguments)

    @property
    def names(self) -> Sequence[str]:
        """Return pipeline names: ``transport[/variant][?option=value&...]``."""
        return self.transports

    @cached_property
    def pipelines(self) -> list[Pipeline]:
        return pipelines(
            self.names,
            {name: options.given_values() for name, options in self.options},
            self.engine.name,
            self.OF_ENGINE,
            every=self.EVERY_VARIANT,
            payloads=self.payload or self.usual_payloads,
            strict=bool(self.payload),
            mode=self.mode,
        )

    @cached_property
    def surroundings(self) -> tuple[Surroundings, ...]:
        wanted = (each.of(self, self.pipelines) for _, each in SURROUNDINGS.loaded())
        return tuple(each for each in wanted if each)

    @property
    def usual_payloads(self) -> tuple[str, ...]:
        """Return the default payloads, for the pipelines that can carry them."""
        return (RAW,)

    @cached_property
    def answer(self) -> str:
        return answer_over(self.engine.wanted, self.pipelines)

    @property
    def served_engine(self) -> EngineConfig:
        return self.engine.but(answer=self.answer)

    @property
    def tuned(self) -> bool:
        """Whether this process and the servers keep large blocks of memory for the next picture."""
        return all(TRANSPORTS[name].tuned(options) for name, options in self.options)

    @property
    def serves_engine(self) -> bool:
        """Whether a server of this package answers over any transport."""
        return not all(pipeline.black_box for pipeline in self.pipelines)

    @property
    def starts_program(self) -> bool:
        """Whether an external server program is started on the model's files."""
        return any(pipeline.transport.program(pipeline.options) for pipeline in self.pipelines)

    @property
    def foreign(self) -> str:
        """Return the first option that names an external server, or nothing."""
        return next(filter(None, (each.options.external for each in self.pipelines)), "")

    @property
    def sent_prompt(self) -> str:
        """Return the prompt; the default for policies is a task."""
        acts = self.answer == ACTIONS or any(each.capabilities.takes_task for each in self.pipelines)
        return DEFAULT_TASK if acts and "prompt" not in self.model_fields_set else self.prompt

    @property
    def reads_model(self) -> bool:
        return self.serves_engine or self.starts_program

    def check(self) -> None:
        if not self.transports:
            raise UsageError(f"`transport`: name at least one of {', '.join(TRANSPORTS)}")
        width, height = self.size
        if not (16 <= width <= LARGEST and 16 <= height <= LARGEST) or width % 2:  # noqa: PLR2004
            raise UsageError(f"`size`: {width}x{height} should be 16x16 to {LARGEST}x{LARGEST}, of even width")
        check_engine(self.engine)
        if self.COMPUTES and not self.engine.kind.computes:
            raise UsageError(f"`engine` {self.engine.name} computes nothing; {self.COMPUTES}: use {computing()}")
        self._check_answer()
        self._check_observation()
        if self.record is not None and self.record.exists():
            raise UsageError(f"`record`: {self.record} exists already and is not overwritten; name another")
        for pipeline in self.pipelines:
            self._check(pipeline)
        if self.engine.kind.plays and self.foreign:
            raise UsageError(f"`engine` {self.engine.name} needs our own servers; leave out `{self.foreign}`")
        if self.engine.latency and self.foreign:
            raise UsageError(f"`latency` is about our own servers; leave out `{self.foreign}`")
        self._check_unused()
        _ = self.surroundings  # raises UsageError

    def _check(self, pipeline: Pipeline) -> None:
        if self.state and not pipeline.capabilities.accepts_state:
            raise UsageError(f"`state`: a request of {pipeline.name} has no place for it; leave one of them out")
        if not (pipeline.transport.serves or pipeline.black_box):
            scheme = pipeline.transport.urls.schemes[0]
            raise UsageError(f"`transport` {pipeline.name} is a client alone: name its `url`, {scheme}://HOST:PORT")
        choice = Choice(pipeline.options, pipeline.variant, self.mode, self.engine.name, self.cameras, self.state)
        pipeline.transport.require(choice)
        require_payload(pipeline, self.mode, resized=self.resize is not None)
        self.served_engine.but(**dict(pipeline.engine))  # raises UsageError for a value in its name
        if pipeline.engine and pipeline.options.external_address:
            raise UsageError(f"`{pipeline.engine[0][0]}`: the server of {pipeline.name} runs already, as it was set")

    def _check_answer(self) -> None:
        if self.answer != ACTIONS:
            return
        alone = carries_alone(ACTIONS, self.pipelines) or "`answer` actions"
        if self.COUNTS_TOKENS:
            raise UsageError(f"{self.COUNTS_TOKENS}, and {alone} brings actions; 's2a-bench latency' measures them")
        if self.serves_engine and "name" in self.engine.model_fields_set and not self.engine.kind.acts:
            raise UsageError(
                f"`engine` {self.engine.name} answers with tokens, and {alone} carries actions; use `engine` {acting()}"
            )

    def _check_observation(self) -> None:
        if self.resize is not None and not all(1 <= side <= LARGEST for side in self.resize):
            raise UsageError(f"`resize`: {self.resize[0]}x{self.resize[1]} should be 1x1 to {LARGEST}x{LARGEST}")
        if self.mode == "stream" and (self.cameras > 1 or self.resize):
            name = "cameras" if self.cameras > 1 else "resize"
            raise UsageError(f"`{name}`: in `mode` stream one camera runs, whose frames are sent as they are")

    def _check_unused(self) -> None:
        """Refuse an external server or its options that no cell uses, and a model that no server loads."""
        used = {(each.transport.name, each.options.external) for each in self.pipelines}
        for name, opts in self.options:
            transport, field = TRANSPORTS[name], opts.external
            if field and (name, field) not in used:
                variants = transport.variants if name in dict(used) else ()
                able = [each for each in variants if transport.capabilities(Choice(opts, each)).options.external]
                fit = [f"{name}/{each}" for each in able]
                raise UsageError(f"`{field}` needs {' or '.join(fit) or name} among `transport`")
        if self.wait_for_server and not any(each.options.external_address for each in self.pipelines):
            raise UsageError("`wait_for_server` is about a server that runs already; name it with `url`")
        cell_options = [each.options for each in self.pipelines]
        useful = {name for each in cell_options for name in each.model_fields_set - each.without_effect}
        if useless := {name for each in cell_options for name in each.without_effect} - useful:
            raise UsageError(f"`{min(useless)}` is about a server that runs already; name it with `url`")
        if (flag := self.engine.of_model) and not self.reads_model:
            raise UsageError(f"`{flag}`: no server of this run loads a model; leave it out with `{self.foreign}`")

    def risks(self) -> Iterator[tuple[str, str, str]]:
        yield from super().risks()
        for pipeline in self.pipelines:
            yield from pipeline.risks()

    def to_manifest(self) -> dict[str, Any]:
        settings = {
            each.name: {**each.options.model_dump(mode="json", exclude_defaults=True), **dict(each.engine)}
            for each in self.pipelines
        }
        fields = self.model_dump(exclude={"quick", "nonce"})  # the nonce stands with the seeds
        width, height = self.size
        size = f"{width}x{height}"
        observation = f"{self.cameras} x {size}" if self.cameras > 1 else size
        observation += f" as {self.resize[0]}x{self.resize[1]}" if self.resize else ""
        observation += f", state of {self.state}" if self.state else ""
        return {
            **fields,
            "prompt": self.sent_prompt,
            "observation": observation,
            "tuned": self.tuned,
            "width": width,
            "height": height,
            "size": size,
            "engine": self.served_engine.to_manifest(),
            "pipelines": settings,
        }


class FirstVariants(RequestsConfig):
    EVERY_VARIANT: ClassVar[bool] = False
