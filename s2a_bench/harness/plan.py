"""What a latency run is asked to do, checked, and the cells that follow from it."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from s2a_bench.errors import UsageError
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.replay import check_replay
from s2a_bench.ros import MIDDLEWARES
from s2a_bench.transport import CONNECTIONS, HTTP_VARIANTS, NAMES, PAYLOADS, QOS_PROFILES, ROS_VARIANTS, WIRES, Route
from s2a_bench.transport.credentials import read_key
from s2a_bench.transport.http.dialects import DIALECTS, open_dialect
from s2a_bench.transport.http.merge import read_patch

LARGEST = 16_384
ROS_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
"""ROS 2's rules for an absolute name."""
MODES = ("request", "stream")
TUNINGS = ("tuned", "default")

DEFAULT_PROMPT = """You are a robot task planner.
Skills: go_to(location), open(object), close(object), pick(object), place(object, location).
Rules: Output only numbered skill calls, one per line.
Do not output any explanation."""
"""The paper's prompt (section IV-E)."""


@dataclass(frozen=True, slots=True)
class LatencyConfig:
    """The settings of one ``s2a-bench latency`` run, as the flags of the same names give them."""

    transports: tuple[str, ...] = ("http", "ros")
    http: tuple[str, ...] = ()
    """Variants; empty: all that the server speaks."""
    ros: tuple[str, ...] = ("topic",)
    action: str = ""
    """The full name of somebody else's action, as a llama_ros node's; then no ROS server is started."""
    result_timeout_s: float = 60.0
    record: Path | None = None
    """Where what travelled is recorded as MCAP."""
    source: str = "synthetic"
    width: int = 640
    height: int = 480
    payload: str = "jpeg"
    wire: str = "bgr"
    connection: str = "keep-alive"
    url: str = ""
    served_model: str = "default"
    """The model's name in requests to a black box."""
    dialect: str = ""
    """What a black box speaks; empty: it is asked."""
    api_key_env: str = ""
    """The environment variable that holds a black box's API key, which itself is nowhere kept."""
    extra_body: str = ""
    """JSON that is merged into every request to a black box."""
    llama_server: Path | None = None
    port: int = 0
    middleware: str = ""
    qos: str = "reliable"
    dds_tuning: str = "tuned"
    domain_id: int = 0
    namespace: str = "/s2a_bench"
    engine: EngineConfig = field(default_factory=EngineConfig)
    runs: int = 50
    warmup: int = 5
    mode: str = "request"
    fps: float = 30.0
    max_tokens: int = 32
    prompt: str = DEFAULT_PROMPT
    grammar: str = ""
    seed: int = 0
    timeout_s: float = 300.0
    sample_resources_hz: float = 10.0
    """How often CPU, memory, GPU and power are read beside the run; 0: never."""

    @property
    def black_box(self) -> bool:
        """Tell whether the HTTP server is somebody else's."""
        return bool(self.url or self.llama_server)

    @property
    def own_engine(self) -> bool:
        """Whether an engine of ours answers over any transport."""
        foreign = {"http": self.black_box, "ros": bool(self.action)}
        return not all(foreign.get(transport, False) for transport in self.transports)

    @property
    def http_variants(self) -> tuple[str, ...]:
        """Return the variants to measure."""
        speaks = HTTP_VARIANTS[:2] if self.black_box else HTTP_VARIANTS
        return self.http or speaks

    def check(self) -> None:
        """Raise UsageError, naming the flag, for a value or combination that makes no sense."""
        if not self.transports:
            raise UsageError(f"--transport: name at least one of {', '.join(NAMES)}")
        _one_of("--transport", self.transports, NAMES)
        _one_of("--http", self.http, HTTP_VARIANTS)
        _one_of("--ros", self.ros, ROS_VARIANTS)
        _one_of("--qos", [self.qos], QOS_PROFILES)
        _one_of("--middleware", [self.middleware] if self.middleware else [], tuple(MIDDLEWARES))
        _one_of("--payload", [self.payload], PAYLOADS)
        _one_of("--wire", [self.wire], WIRES)
        _one_of("--connection", [self.connection], CONNECTIONS)
        _one_of("--mode", [self.mode], MODES)
        _one_of("--dds-tuning", [self.dds_tuning], TUNINGS)
        for flag, value, least, most in (
            ("--runs", self.runs, 1, 10**9),
            ("--warmup", self.warmup, 0, 10**9),
            ("--max-tokens", self.max_tokens, 1, 2**20),
            ("--seed", self.seed, 0, 2**31 - 1),
            ("--timeout", self.timeout_s, 0.1, 86_400),
            ("--result-timeout", self.result_timeout_s, 0, 86_400),
            ("--fps", self.fps, 0.1, 1_000),
            ("--sample-resources", self.sample_resources_hz, 0, 1_000),
        ):
            if not least <= value <= most:
                raise UsageError(f"{flag}: {value} is not between {least} and {most}")
        if not (16 <= self.width <= LARGEST and 16 <= self.height <= LARGEST) or self.width % 2:  # noqa: PLR2004
            raise UsageError(
                f"--size: {self.width}x{self.height} should be 16x16 to {LARGEST}x{LARGEST}, of even width"
            )
        if not ROS_NAME.fullmatch(self.namespace):
            raise UsageError(f"--namespace: '{self.namespace}' should look like /name: letters, digits, underscores")
        for flag, text in (("--prompt", self.prompt), ("--grammar", self.grammar)):
            if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
                raise UsageError(f"{flag}: the text is not valid UTF-8, or has a NUL")
        check_replay(self.engine)
        if self.engine.name == "replay" and (self.black_box or self.action):
            flag = "--url" if self.url else "--llama-server" if self.llama_server else "--action"
            raise UsageError(f"--engine replay needs our own servers; leave out {flag}")
        self._check_black_box()
        self._check_action()
        self._check_stream()

    def _check_black_box(self) -> None:
        if self.url and self.llama_server:
            raise UsageError("--url and --llama-server name two HTTP servers; give one of them")
        self._check_dialect()
        if not self.black_box:
            return
        flag = "--url" if self.url else "--llama-server"
        if "http" not in self.transports:
            raise UsageError(f"{flag} needs http among --transport")
        if self.url and not _is_url(self.url):
            raise UsageError(f"--url: '{self.url}' should start with http:// or https:// and name a host")
        if "@" in urlsplit(self.url).netloc:
            raise UsageError("--url: leave the password out, which would be kept with the results; see --api-key-env")
        payloads = open_dialect(self.dialect or "openai").payloads
        if self.payload not in payloads:
            spoken = f"--dialect {self.dialect}" if self.dialect else flag
            raise UsageError(f"--payload {self.payload}: with {spoken} a picture travels as {' or '.join(payloads)}")
        if "binary" in self.http:
            raise UsageError(f"--http binary needs our own server; leave it out with {flag}")
        if self.llama_server and self.engine.name != "llama":
            raise UsageError(f"--llama-server runs a model; leave out --engine {self.engine.name}")

    def _check_dialect(self) -> None:
        given = {"--dialect": self.dialect, "--api-key-env": self.api_key_env, "--extra-body": self.extra_body}
        for flag, value in given.items():
            if value and not self.url:
                raise UsageError(f"{flag} is about a server that runs already; name it with --url")
        _one_of("--dialect", [self.dialect] if self.dialect else [], tuple(DIALECTS))
        read_key(self.api_key_env)
        read_patch(self.extra_body)

    def _check_action(self) -> None:
        if "ros" in self.transports and not self.ros:
            raise UsageError(f"--ros: name at least one of {', '.join(ROS_VARIANTS)}")
        if self.action:
            if not ROS_NAME.fullmatch(self.action):
                raise UsageError(f"--action: '{self.action}' should look like /llama/generate_response")
            if "ros" not in self.transports:
                raise UsageError("--action needs ros among --transport")
            if self.mode == "stream":
                raise UsageError("--action: --mode stream needs our own server, which keeps the camera's newest frame")
        if self.wire == "compressed" and self.mode == "request" and (self.action or "action" in self.ros):
            raise UsageError("--wire compressed: a goal carries sensor_msgs/Image; use --wire bgr, or --ros topic")

    def _check_stream(self) -> None:
        if self.record is not None and self.record.exists():
            raise UsageError(f"--record: {self.record} exists already and is not overwritten; name another")
        if self.mode == "stream" and self.payload == "jpeg-preencoded":
            raise UsageError("--payload jpeg-preencoded has no meaning in --mode stream; use jpeg")

    def to_manifest(self) -> dict[str, Any]:
        """Return the settings as plain data."""
        return {
            **asdict(self),
            "engine": self.engine.to_manifest(),
            "http": list(self.http_variants),
            "size": f"{self.width}x{self.height}",
        }


def _is_url(text: str) -> bool:
    """Tell whether a text names an HTTP server."""
    try:
        parts = urlsplit(text)
        return parts.scheme in {"http", "https"} and bool(parts.hostname) and parts.port != 0
    except ValueError:
        return False


def _one_of(flag: str, values: tuple[str, ...] | list[str], known: tuple[str, ...]) -> None:
    for value in values:
        if value not in known:
            raise UsageError(f"{flag}: '{value}' is none of {', '.join(known)}")


@dataclass(frozen=True, slots=True)
class Cell:
    """One thing that is compared: a pipeline with its settings."""

    name: str
    route: Route
    payload: str
    """What travels: the HTTP payload, the ROS wire format, or nothing for loopback."""


def route_of(config: LatencyConfig, transport: str, address: str) -> Route:
    """Return how a transport is wired in a run, for its server and, with a variant added, for its clients."""
    return Route(
        transport=transport,
        address=address,
        payload=config.payload,
        wire=config.wire,
        connection=config.connection,
        middleware=config.middleware,
        qos=config.qos,
        dds_tuning=config.dds_tuning,
        domain_id=config.domain_id,
        max_tokens=config.max_tokens,
        result_timeout_s=config.result_timeout_s,
        timeout_s=config.timeout_s,
        model=config.served_model,
        dialect="llama-server" if config.llama_server else config.dialect,
        api_key_env=config.api_key_env,
        extra_body=config.extra_body,
    )


def plan_cells(config: LatencyConfig, addresses: dict[str, str]) -> list[Cell]:
    """List the cells of a run; ``addresses`` maps each transport to where its server is."""
    cells = []
    for transport in config.transports:
        route = route_of(config, transport, addresses[transport])
        if transport == "http":
            cells += [
                Cell(f"http/{variant}", replace(route, variant=variant, black_box=config.black_box), config.payload)
                for variant in config.http_variants
            ]
        elif transport == "ros":
            variants = ("action",) if config.action else config.ros
            route = replace(route, action=config.action, black_box=bool(config.action))
            cells += [Cell(f"ros/{variant}", replace(route, variant=variant), config.wire) for variant in variants]
        else:
            cells.append(Cell(transport, route, ""))
    return cells
