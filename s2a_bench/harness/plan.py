"""What a run of requests is asked to do, checked, and the pipelines that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

from pydantic import create_model

from s2a_bench import extras
from s2a_bench.errors import UsageError
from s2a_bench.facts import FRAMES_LOST, FRAMES_PUBLISHED, facts_json
from s2a_bench.frames import SOURCES
from s2a_bench.inference import ACTING, EngineConfig, acts, check_engine, default_engine
from s2a_bench.machine.resources.rows import SPENT
from s2a_bench.options import Grammar, Names, Options, Size, Square, TextOrFile, group, option
from s2a_bench.trace import path_of
from s2a_bench.transport import ACTIONS, TRANSPORTS, Transport, named_by
from s2a_bench.transport.options import PAYLOADS, SERVING, Payload, sides
from s2a_bench.transport.pipeline import Pipeline, answer_over, pipelines, require_payload

LARGEST = 16_384

DEFAULT_PROMPT = """You are a robot task planner.
Skills: go_to(location), open(object), close(object), pick(object), place(object, location).
Rules: Output only numbered skill calls, one per line.
Do not output any explanation."""
"""The paper's prompt (section IV-E)."""


def _options() -> type[Options]:
    """Make a group of the options of each transport; what only concerns `serve` is no flag."""
    return _made(
        {
            name: (each.options, group(each.options, only=[n for n, side in sides(each.options) if side != SERVING]))
            for name, each in TRANSPORTS.loaded()
        }
    )


def _variants(*, first: bool) -> type[Options]:
    """Make an option for each transport with variants: which to measure, unless told the first or its own choice."""
    fields: dict[str, Any] = {}
    for name, each in TRANSPORTS.loaded():
        if each.variants:
            about = f"{', '.join(each.variants)}; several with commas"
            measured = each.variants[:1] if first else each.measured(each.options(), (), "")
            default = measured if first else ()
            fields[name] = (Names, option(default, f"{about} [default: {','.join(measured)}]"))
    return _made(fields)


def _schemes() -> list[str]:
    """Return what URLs of servers begin with."""
    return [f"{scheme}://" for _, each in TRANSPORTS.loaded() for scheme in each.schemes]


def _with_url(url: str, options: Options | Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of transports, the one that a URL's scheme names told the URL."""
    told = {name: own if isinstance(own, Mapping) else _said(own) for name, own in dict(options).items()}
    name = named_by(url)
    return {**told, name: {**told.get(name, {}), "url": url}}


def _said(options: Options) -> dict[str, Any]:
    return {name: getattr(options, name) for name in options.model_fields_set}


def _made(fields: dict[str, Any]) -> type[Options]:
    made: type[Options] = create_model("PerTransport", __base__=Options, **fields)
    return made


if TYPE_CHECKING:
    TransportOptions: TypeAlias = Options
    Variants: TypeAlias = Options
    FirstVariants: TypeAlias = Options
else:
    TransportOptions = _options()
    Variants = _variants(first=False)
    FirstVariants = _variants(first=True)


class RequestsConfig(Options):
    """The settings of one run of requests."""

    QUICK: ClassVar[dict[str, int]] = {"runs": 10, "warmup": 2, "max_tokens": 8}
    """What ``quick`` sets, unless told."""
    COUNTS_TOKENS: ClassVar[str] = "this command counts tokens"
    """Why answers of actions are no use here; empty: they are."""

    transports: Names = option(
        ("http", "ros"),
        f"{', '.join(TRANSPORTS)}; several with commas, with /VARIANT and ?OPTION=VALUE: ros/topic?payload=yuyv",
        flag="transport",
    )
    source: str = option("synthetic", f"{', '.join(SOURCES)}, as video:FILE")
    size: Size = option((640, 480), "WIDTHxHEIGHT of the frames [default: 640x480]")
    cameras: int = option(1, "pictures a request, read one after the other from the source", ge=1, le=16)
    resize: Square | None = option(
        None, "WIDTHxHEIGHT, or 224 for 224x224: pictures are scaled to it before they travel [default: as captured]"
    )
    state: int = option(0, "numbers (float32) of the robot's state that go with a request", ge=0, le=4096)
    payload: Payload = option("", f"how a picture travels: {', '.join(PAYLOADS)} [default: http jpeg, ros raw]")
    variants: Variants = group(Variants)
    """The variants to measure where a pipeline's name has none; those that a transport measures by default if empty."""
    options: TransportOptions = group(TransportOptions)
    """The options of every transport, for names that do not say them themselves."""
    url: str = option(
        "", f"a server that runs already (a black box), of the transport that its scheme names: {', '.join(_schemes())}"
    )
    engine: EngineConfig = group(EngineConfig)
    runs: int = option(50, "samples a pipeline [default: 50, quick: 10]", ge=1, le=10**9)
    warmup: int = option(5, "warm-ups a pipeline, kept and marked [default: 5, quick: 2]", ge=0, le=10**9)
    launches: int = option(1, "fresh sets of servers, --runs samples each; ratios then hold beyond one", ge=1, le=1000)
    mode: Literal["request", "stream"] = option("request", "request (a frame each), stream (a camera runs)")
    fps: float = option(30.0, "rate of the camera in --mode stream", ge=0.1, le=1000)
    max_tokens: int = option(32, "tokens an answer [default: 32, quick: 8]", ge=1, le=2**20)
    prompt: TextOrFile = option(DEFAULT_PROMPT, "text, or @FILE [default: the paper's prompt]")
    grammar: Grammar = option("", "GBNF file that every answer obeys")
    seed: int = option(0, "seed of the order, the source and the sampling", ge=0, le=2**31 - 1)
    nonce: str = option(
        "",
        "nonce of another run, to send its very pictures again [default: a new one]",
        pattern="^[0-9A-Za-z_-]{0,64}$",
    )
    timeout_s: float = option(300.0, "longest silence of a server, in seconds", flag="timeout", ge=0.1, le=86_400)
    deadline_s: float = option(
        0.0,
        "longest time of a whole answer, in seconds; 0: --timeout and 5 s a token",
        flag="deadline",
        ge=0,
        le=86_400,
    )
    sample_resources_hz: float = option(
        10.0,
        "readings a second of CPU, memory, GPU and power beside the run; 0: none",
        flag="sample-resources",
        ge=0,
        le=1000,
    )
    record: Path | None = option(None, "also record frames, requests and tokens, as run.mcap (rosbag2)")
    quick: bool = option(False, "fewer samples: a first look")

    def __init__(self, **given: Any) -> None:
        """Keep what is given, few samples where a quick look is asked for; raises UsageError naming the field."""
        given = {**self.QUICK, **given} if given.get("quick") else given
        if given.get("url"):
            given["options"] = _with_url(given["url"], given.get("options") or {})
        super().__init__(**given)

    @property
    def width(self) -> int:
        """Return the width of the frames in pixels."""
        return self.size[0]

    @property
    def height(self) -> int:
        """Return the height of the frames in pixels."""
        return self.size[1]

    @property
    def names(self) -> Sequence[str]:
        """Return pipeline names: ``transport[/variant][?option=value&...]``."""
        return self.transports

    @cached_property
    def pipelines(self) -> list[Pipeline]:
        """Return what is compared, a cell each; raises UsageError."""
        told = {name: _said(given) for name, given in self.options}
        return pipelines(self.names, {**told, "": {"payload": self.payload}}, dict(self.variants), self.engine.name)

    @cached_property
    def answer(self) -> str:
        """Return what the answers of all cells are made of; raises UsageError."""
        return answer_over(self.engine.answer, self.pipelines)

    @property
    def served_engine(self) -> EngineConfig:
        """Return the engine as servers are told."""
        return self.engine.but(answer=self.answer)

    @property
    def most_pieces(self) -> int:
        """Return the most tokens, or actions, of an answer."""
        return self.engine.horizon if self.answer == ACTIONS else self.max_tokens

    @property
    def used(self) -> list[Transport[Any]]:
        """Return the transports, each once."""
        return list({pipeline.transport.name: pipeline.transport for pipeline in self.pipelines}.values())

    @property
    def tuned(self) -> bool:
        """Whether this process and the servers keep large blocks of memory for the next picture."""
        return all(TRANSPORTS[name].tuned(given) for name, given in self.options)

    @property
    def stages(self) -> dict[str, str]:
        """Return stage -> group of the transports, in the order of the path."""
        return path_of(transport.stages for transport in self.used)

    @property
    def facts(self) -> dict[str, dict[str, str]]:
        """Return fact -> unit and meaning, of all that may be told of a request."""
        told = [fact for each in self.pipelines for fact in each.transport.told(each.options)]
        told += self.engine.told if self.own_engine else ()
        told += (FRAMES_PUBLISHED, FRAMES_LOST) if self.mode == "stream" else ()
        return facts_json([*told, *(SPENT if self.sample_resources_hz else ())])

    @property
    def packages(self) -> list[str]:
        """Return the packages whose versions belong beside the results of the transports."""
        return [package for transport in self.used for package in transport.packages]

    @property
    def own_engine(self) -> bool:
        """Whether an engine of ours answers over any transport."""
        return not all(pipeline.black_box for pipeline in self.pipelines)

    @property
    def starts_program(self) -> bool:
        """Whether somebody else's server is started on the model's files."""
        return any(pipeline.transport.program(pipeline.options) for pipeline in self.pipelines)

    @property
    def foreign(self) -> str:
        """Return the first option that says that a server is not ours, or nothing."""
        found = (pipeline.transport.foreign_by(pipeline.options) for pipeline in self.pipelines)
        return next((name for name in found if name), "")

    def answered(self, say: Callable[[str], None]) -> RequestsConfig:
        """Return it with the engine that can answer where none is named, and ``say`` which if that is not llama."""
        if "name" in self.engine.model_fields_set or not self.own_engine:
            return self
        if self.answer == ACTIONS:
            say("the echo engine answers with actions; a model's are those of its own server, see `url`")
            return self.but(engine=self.engine.but(name="echo"))
        if self.starts_program and not extras.installed("llama_cpp"):
            only = [each.name for each in self.pipelines if each.transport.program(each.options)]
            say(f"only {', '.join(only)}: our own servers have no engine here; {extras.how_to_install('llama')}")
            return self.but(transports=only)
        chosen = self.but(engine=self.engine.but(name=default_engine(say)))
        if left_out := {each.name for each in self.pipelines} - {each.name for each in chosen.pipelines}:
            say(f"{', '.join(sorted(left_out))}: left out, as it needs a model")
        return chosen

    def check(self) -> None:
        """Raise UsageError, naming the field, for a combination that makes no sense."""
        if not self.transports:
            raise UsageError(f"`transport`: name at least one of {', '.join(TRANSPORTS)}")
        if not (16 <= self.width <= LARGEST and 16 <= self.height <= LARGEST) or self.width % 2:  # noqa: PLR2004
            raise UsageError(
                f"`size`: {self.width}x{self.height} should be 16x16 to {LARGEST}x{LARGEST}, of even width"
            )
        check_engine(self.engine)
        self._check_answer()
        self._check_observation()
        if self.record is not None and self.record.exists():
            raise UsageError(f"`record`: {self.record} exists already and is not overwritten; name another")
        for pipeline in self.pipelines:
            self._check(pipeline)
        if self.launches > 1 and self.foreign:
            raise UsageError(
                f"`launches`: a server that runs already cannot be started afresh; leave out `{self.foreign}`"
            )
        if self.engine.name == "replay" and self.foreign:
            raise UsageError(f"`engine` replay needs our own servers; leave out `{self.foreign}`")
        if self.engine.latency and self.foreign:
            raise UsageError(f"`latency` is about our own servers; leave out `{self.foreign}`")
        self._check_unused()

    def _check(self, pipeline: Pipeline) -> None:
        """Check one cell against the settings of the run."""
        pipeline.transport.check(pipeline.variant, pipeline.options, mode=self.mode, engine=self.engine.name)
        require_payload(pipeline)
        if self.mode == "stream" and pipeline.payload == "jpeg-preencoded":
            raise UsageError("`payload` jpeg-preencoded has no meaning in `mode` stream; use jpeg")

    def _check_answer(self) -> None:
        """Check that what the answers are made of can be said, and is of use."""
        if self.answer != ACTIONS:
            return
        if self.COUNTS_TOKENS:
            carrier = next((each.name for each in self.pipelines if each.answers == (ACTIONS,)), "`answer` actions")
            raise UsageError(f"{self.COUNTS_TOKENS}, and {carrier} brings actions; 's2a-bench latency' measures them")
        if self.own_engine and "name" in self.engine.model_fields_set and not acts(self.engine.name):
            alone = next(each.name for each in self.pipelines if each.answers == (ACTIONS,))
            raise UsageError(
                f"`engine` {self.engine.name} answers with tokens, and {alone} carries actions; use `engine` {ACTING}"
            )

    def _check_observation(self) -> None:
        """Check that what a request brings can be made, and carried."""
        if self.resize is not None and not all(1 <= side <= LARGEST for side in self.resize):
            raise UsageError(f"`resize`: {self.resize[0]}x{self.resize[1]} should be 1x1 to {LARGEST}x{LARGEST}")
        if self.mode == "stream" and (self.cameras > 1 or self.resize):
            name = "cameras" if self.cameras > 1 else "resize"
            raise UsageError(f"`{name}`: in `mode` stream one camera runs, whose frames travel as they are")
        for pipeline in self.pipelines:
            if self.resize and pipeline.payload in {"yuyv", "jpeg-preencoded"}:
                raise UsageError(
                    f"`resize`: {pipeline.payload} is what the camera gave; use `payload` raw, jpeg or png"
                )
            if self.state and not pipeline.transport.takes_state(pipeline.variant, pipeline.options):
                raise UsageError(f"`state`: a request of {pipeline.name} has no place for it; leave one of them out")

    @property
    def observation(self) -> str:
        """Return what a request brings besides the prompt, in words: 3 x 640x480 as 224x224, state of 14."""
        size = f"{self.width}x{self.height}"
        said = f"{self.cameras} x {size}" if self.cameras > 1 else size
        said += f" as {self.resize[0]}x{self.resize[1]}" if self.resize else ""
        return f"{said}, state of {self.state}" if self.state else said

    def _check_unused(self) -> None:
        """Refuse a server of somebody else's that nobody would ask."""
        used = {transport.name for transport in self.used}
        for name, given in self.options:
            if name not in used and (field := TRANSPORTS[name].foreign_by(given)):
                raise UsageError(f"`{field}` needs {name} among `transport`")

    def to_manifest(self) -> dict[str, Any]:
        """Return the settings as plain data, with what every pipeline came to be told."""
        told = {each.name: each.options.model_dump(mode="json", exclude_defaults=True) for each in self.pipelines}
        own = self.model_dump(exclude={"quick", "nonce"})  # the nonce stands with the seeds
        size = {"width": self.width, "height": self.height, "size": f"{self.width}x{self.height}"}
        size |= {"observation": self.observation}
        return {**own, **size, "tuned": self.tuned, "engine": self.served_engine.to_manifest(), "pipelines": told}
