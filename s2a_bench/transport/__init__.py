"""Transports: a Client sends a request and yields tokens or actions, a Server feeds requests to a Handler.

CONTRIBUTING.md says how a package adds one, and which example there is; `testing.transport` has the conformance suite.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from math import inf
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, Final, Generic, Protocol, TypeAlias, TypeVar, cast

from s2a_bench import extras
from s2a_bench import options as base
from s2a_bench.errors import UsageError
from s2a_bench.facts import Fact
from s2a_bench.registry import Registry
from s2a_bench.trace import Trace
from s2a_bench.transport.limits import LIMITS, Bounds, Limits
from s2a_bench.types import Frame, Piece, Request

PAYLOADS: Final = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
"""Forms of a picture, in the order of tables: BGR pixels, the camera's YUYV, JPEG, JPEG encoded before the run, PNG."""
RAW, YUYV, JPEG, PREENCODED, PNG = PAYLOADS

LOSSLESS: Final = frozenset({"", RAW, YUYV, PNG})
"""Payloads that give the engine the camera's exact pixels; "" where no picture is sent."""

TRANSPORT: Final = "Transport"

SERVER: Final = "server"
"""``side`` of an option that the server process needs too: cells that differ in it get separate servers."""

SERVING: Final = "serving"
"""``side`` of such an option that is a flag of `serve` only; a run has it in the name of a pipeline."""

EXTERNAL: Final = "external"
"""``side`` of an option that holds the address of a running external server."""

PROGRAM: Final = "program"
"""``side`` of an option that names an external server for the run to start: see `Transport.program`."""


Payload = Annotated[str, base.one_of(lambda: ("", *PAYLOADS))]
Payloads = Annotated[tuple[Payload, ...], base.SEVERAL]


def payload_order(payload: str) -> int:
    """Return the place of a payload in tables; unknown payloads come last."""
    return PAYLOADS.index(payload) if payload in PAYLOADS else len(PAYLOADS)


@dataclass(frozen=True, slots=True)
class Program:
    """An external server that a run starts on its model files: its kind, the program, its port (0: any)."""

    kind: str
    path: Path
    port: int


class TransportOptions(base.Options):
    """Options of every transport. An option belongs to the client unless its ``side`` says otherwise."""

    PANEL: ClassVar[str] = TRANSPORT
    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {}
    """Defaults that differ in `serve`."""
    NOT_SERVE_FLAGS: ClassVar[tuple[str, ...]] = ()
    """Options without a flag of `serve`, which takes them in the pipeline's name, its file or ``--ros-args``."""

    payload: Payload = base.option("", f"how pictures are sent: {', '.join(PAYLOADS)} [default: raw where it can]")

    @classmethod
    def of_sides(cls, *sides: str) -> list[str]:
        """Return the options with one of these sides; "" is the client's."""
        return [name for name, field in cls.model_fields.items() if str(base.extra_of(field).get("side", "")) in sides]

    @property
    def external(self) -> str:
        return next((name for name in self.of_sides(EXTERNAL, PROGRAM) if getattr(self, name)), "")

    @property
    def external_address(self) -> str:
        return next((getattr(self, name) for name in self.of_sides(EXTERNAL)), "")

    @property
    def without_effect(self) -> set[str]:
        """Return the given options that only a server at a `url` reads, where there is none."""
        return set()


O = TypeVar("O", bound=TransportOptions)  # noqa: E741 - the one type variable here

TOKENS: Final = "tokens"
ACTIONS: Final = "actions"

TOKEN_S: Final = 5.0
"""Seconds of the default deadline for each token; far slower than any model that a robot could wait for."""

Handler: TypeAlias = "Callable[[Request, Trace], Generator[Piece, None, None]]"
"""Serves a request whose pictures are ``rgb8``: yields tokens or actions, and marks the trace.

A handler marks `queue` if it waited for a free engine, `inference` at the first piece, and appends the time of
every piece to ``trace.token_ns``. Transports know handlers, never engines.
"""


class CameraSink(Protocol):
    """Takes a running camera's frames where the server keeps the newest one itself (stream mode)."""

    def stamp_ns(self, frame: Frame) -> int:
        """Return the ROS-time stamp that will name this frame in the server's marks."""

    def publish(self, frame: Frame, trace: Trace) -> None:
        """Convert, pack and send one frame, marking each stage."""


class Client(Protocol):
    """One side of one pipeline. Not thread-safe; one request at a time."""

    @property
    def camera(self) -> CameraSink | None:
        """None where the newest frame goes with the prompt instead. The first use may wait for the server."""
        return None

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        """Send a request with its frames as captured, yield pieces as they arrive, mark every stage.

        After the last piece ``trace.remote`` holds the server's marks. Raises RequestFailed when the server
        refuses, breaks off or exceeds the bounds of `transport.limits`, ServerDied when it has ended.
        """

    def describe(self) -> dict[str, str]:
        """Return the manifest's facts about the client beside its wiring."""
        return {}

    def close(self) -> None:
        """Close connections; may be called twice."""


class Server(Protocol):
    """Receives requests, hands each to a handler and sends back what that yields."""

    address: str
    """The address for clients of the same transport, known once the server exists."""

    def describe(self) -> dict[str, str | int]:
        """Return the manifest's facts about the server."""

    def serve(self) -> None:
        """Serve until `stop` is called from another thread or a signal handler."""

    def stop(self) -> None:
        """Make `serve` return soon; may be called twice, from any thread."""


@dataclass(frozen=True, slots=True)
class Wiring(Generic[O]):
    """The settings of a client or a server process: one pipeline and the address of its other end."""

    transport: str
    variant: str
    options: O
    """``options.payload`` is filled in, with the transport's default if need be."""
    address: str = ""
    """For a client the server's address; for a server the address to bind, or the one that it had; empty: any."""
    black_box: bool = False
    """Whether the server is external and sends no marks."""
    timeout_s: float = 300.0
    """The longest silence before a request counts as failed."""
    deadline_s: float = 0.0
    """The longest time for a whole answer; 0: the longest silence, and `TOKEN_S` for each token."""
    max_tokens: int = 512
    """The most tokens of a request that has no such field."""
    limits: Limits = LIMITS
    restarted: bool = False
    """Whether a server replaces one that died, whose end the network may not have noticed yet."""

    def to_json(self) -> dict[str, Any]:
        settings = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**settings, "options": self.options.model_dump(mode="json"), "limits": self.limits.to_manifest()}

    @property
    def capabilities(self) -> Capabilities[O]:
        return TRANSPORTS[self.transport].capabilities(Choice(self.options, self.variant))

    def bounds(self, server: str, max_tokens: int) -> Bounds:
        """Return the bounds of an answer that begins now; errors call the server ``server``."""
        return Bounds(server, self.deadline_s or self.timeout_s + TOKEN_S * max_tokens, max_tokens)

    @staticmethod
    def from_json(settings: Mapping[str, Any]) -> Wiring[Any]:
        options = TRANSPORTS[settings["transport"]].options.model_validate(settings["options"])
        return Wiring(**{**settings, "options": options, "limits": Limits(**settings["limits"])})


@dataclass(frozen=True, slots=True)
class Choice(Generic[O]):
    options: O
    variant: str = ""
    mode: str = ""
    """The request mode: request or stream."""
    engine: str = ""
    cameras: int = 1
    state: int = 0


@dataclass(frozen=True, slots=True)
class Capabilities(Generic[O]):
    """The capabilities of a choice; see the attributes of `Transport`."""

    options: O
    """The options as they hold for the variant."""
    payloads: tuple[str, ...]
    answer_kinds: tuple[str, ...]
    accepts_state: bool
    facts: Sequence[Fact]
    """Facts that may come, from an external server too."""
    server: str = ""
    """The name of the transport's server that serves the variant."""
    takes_task: bool = False
    """Whether the server is a policy, whose prompt is a short task, though its answers count as tokens."""


@dataclass(frozen=True, slots=True)
class Urls:
    """The URLs of external servers that a transport's option `url` takes."""

    schemes: tuple[str, ...] = ()
    examine: str = ""
    """``module:function`` for `doctor --url`, see `transport.risks`."""
    unpickles: str = ""
    """The servers of these that run code that a client sends, as a sentence."""
    cache_hits: str = ""
    """``module:function`` that returns counter -> cache hits that the server of a wiring has counted so far."""


@dataclass(frozen=True, slots=True)
class Sleep:
    """The sleep of an external server after each request, which some of its start options avoid."""

    fact: Fact
    """The time that the client waited for an answer, in ms."""
    ms: float
    advice: str


class Transport(Generic[O]):
    """The declaration of a transport; subclass it, and make one instance."""

    name: ClassVar[str] = ""
    options: type[O]
    variants: ClassVar[tuple[str, ...]] = ()
    """The variants that may follow its name, as ``http/binary``; the first is the default."""
    payloads: ClassVar[tuple[str, ...]] = ()
    """Forms of a picture; the first is the default where raw is not possible. Empty where no picture is sent."""
    answer_kinds: ClassVar[tuple[str, ...]] = (TOKENS,)
    """The kinds of answers: tokens, actions."""
    accepts_state: ClassVar[bool] = False
    stages: ClassVar[Mapping[str, str]] = {}
    """Stage -> group (one of `trace.GROUPS`), in addition to `trace.STAGES`."""
    facts: ClassVar[Sequence[Fact]] = ()
    """Facts of its client and server, without those of the handler."""
    order: ClassVar[float] = 50
    style: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """Variant ("" for none) -> colour and line style, in every figure."""
    compared_with: ClassVar[tuple[str, ...]] = ("loopback",)
    """Transports whose cells are the denominators of its ratios."""
    packages: tuple[str, ...] = ()
    """Python packages whose versions are recorded with its results."""
    checks: ClassVar[Mapping[str, str]] = {}
    """Code -> ``module:function`` of the doctor's checks for it."""
    udp_checks: ClassVar[tuple[str, ...]] = ()
    """Codes of the checks that matter before a run that sends large pictures by UDP, whose packets can be lost."""
    in_process: ClassVar[bool] = False
    """Whether its server is a thread of the client's process."""
    serves: ClassVar[bool] = True
    """Whether it has a server of ours; else it is a client alone."""
    crosses_links: ClassVar[bool] = True
    """Whether its client reaches its server through the network, which can be emulated."""
    urls: ClassVar[Urls] = Urls()
    sleep: ClassVar[Sleep | None] = None
    client_class: ClassVar[str] = ""
    """``module:class``, made of a wiring and ``alive``, where `client` is not overridden."""
    server_class: ClassVar[str] = ""
    """``module:class``, made of a wiring, whose limits it enforces, and a handler, where `server` is not overridden."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The extra of both, and its modules."""
    reader: ClassVar[str] = ""
    """``module:class`` that reads what passes through a tap, a `tap.TapReader`."""

    def client(self, wiring: Wiring[O], alive: Callable[[], bool]) -> Client:
        self.check_machine()
        return cast("Client", resolve_name(self.client_class)(wiring, alive))

    def server(self, wiring: Wiring[O], handler: Handler) -> Server:
        self.check_machine()
        return cast("Server", resolve_name(self.server_class)(wiring, handler))

    def check_machine(self) -> None:
        """Raise MissingExtra, or UsageError for a system that it cannot run on."""
        if self.needs:
            extras.need(*self.needs)

    def measured(self, choice: Choice[O]) -> Sequence[str]:  # noqa: ARG002 - for those whose variants depend on it
        return self.variants[:1] or ("",)

    def capabilities(self, choice: Choice[O]) -> Capabilities[O]:
        return Capabilities(choice.options, self.payloads, self.answer_kinds, self.accepts_state, self.facts)

    def require(self, choice: Choice[O]) -> None:  # noqa: ARG002 - for those that depend on it
        """Raise UsageError for options that conflict with the rest of a choice, or with this machine."""
        self.check_machine()

    def tuned(self, options: O) -> bool:  # noqa: ARG002 - for those whose options decide, here and below
        """Return whether processes are tuned: they keep large blocks of memory for the next picture, for example."""
        return True

    def datagrams(self, options: O) -> bool:  # noqa: ARG002
        """Return whether requests travel as UDP datagrams rather than over TCP."""
        return False

    def against_loss(self, options: O) -> str:  # noqa: ARG002
        """Return the way out where messages are lost."""
        return "check the network"

    def addresses(self, options: O) -> Iterable[str]:  # noqa: ARG002
        """Return the addresses that a new server tries to bind, in order."""
        return ("",)

    def program(self, options: O) -> Program | None:  # noqa: ARG002
        """Return the external server that a run starts, if the options name one."""
        return None

    def ready(self, wiring: Wiring[O]) -> str:
        """Return the line that `serve` prints once the server is bound at ``wiring.address``."""
        return f"serving {wiring.transport} at {wiring.address}"


TRANSPORTS: Final[Registry[Transport[Any]]] = Registry(
    "transports",
    "transport",
    {
        "http": "s2a_bench.transport.http:HTTP",
        "ros": "s2a_bench.transport.ros:ROS",
        "loopback": "s2a_bench.transport.loopback:LOOPBACK",
    },
)


class _UndeclaredTransport(Transport[TransportOptions]):
    options = TransportOptions
    order = inf


@cache
def declared_transport(name: str) -> Transport[Any]:
    """Return the declaration of a transport, or a neutral one if it is not installed: results outlive packages."""
    try:
        return TRANSPORTS[name]
    except UsageError:
        return _UndeclaredTransport()


def paths() -> Iterator[str]:
    """Yield the first parts of pipeline names: every transport, and its variants as TRANSPORT/VARIANT."""
    for name, transport in TRANSPORTS.loaded():
        yield from (name, *(f"{name}/{variant}" for variant in transport.variants))


def named_by(url: str) -> str:
    """Return the transport of a URL's scheme, ``http`` without one; raises UsageError for an unknown scheme."""
    scheme, mark, _ = url.partition("://")
    by_scheme = {scheme: name for name, each in TRANSPORTS.loaded() for scheme in each.urls.schemes}
    if mark and scheme.lower() not in by_scheme:
        raise UsageError(
            f"`url`: no installed transport speaks {scheme}://, only {', '.join(f'{each}://' for each in by_scheme)}"
        )
    return by_scheme.get(scheme.lower(), "http")


def open_client(wiring: Wiring[Any], alive: Callable[[], bool] = lambda: True) -> Client:
    """Connect to the server of a wiring; ``alive`` returns whether its process still runs."""
    return TRANSPORTS[wiring.transport].client(wiring, alive)


def open_server(wiring: Wiring[Any], handler: Handler) -> Server:
    """Bind a server, ready to `serve`; raises PortInUse or TransportError."""
    return TRANSPORTS[wiring.transport].server(wiring, handler)
