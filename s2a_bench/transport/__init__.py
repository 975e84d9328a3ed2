"""How pictures and answers travel: a Client sends a request and yields tokens or actions, a Server feeds a Handler.

To add a transport, write a package with a module like this, and offer its instance as an entry point of the group
``s2a_bench.transports``; nothing in this repository changes::

    from s2a_bench.options import option
    from s2a_bench.transport import SERVER, Options, Transport

    class ToyOptions(Options):
        port: int = option(0, "port; 0: any free one", ge=0, le=65535, side=SERVER)

    class Toy(Transport[ToyOptions]):
        name, options = "toy", ToyOptions           # --transport 'toy?port=7000', serve toy
        payloads = ("raw",)                         # the first where raw cannot travel
        stages = {"frame_length": "pack"}           # marked by its client or server, beside those of trace.STAGES
        facts = (PAYLOAD_BYTES,)                    # the numbers beside the marks, those of its own as facts.Fact(...)

        def client(self, wiring, alive):
            from toy.client import ToyClient        # what is heavy is imported here
            return ToyClient(wiring, alive)

        def server(self, wiring, handler):
            from toy.server import ToyServer        # keeps what wiring.limits says
            return ToyServer(wiring, handler)

    TOY = Toy()

    [project.entry-points."s2a_bench.transports"]
    toy = "toy:TOY"

`s2a_bench.testing.transport` is the suite that it should pass.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Generic, Protocol, TypeAlias, TypeVar

from s2a_bench import options as base
from s2a_bench.errors import UsageError
from s2a_bench.registry import Registry
from s2a_bench.transport.limits import LIMITS, Limits

if TYPE_CHECKING:
    from s2a_bench.facts import Fact
    from s2a_bench.trace import Trace
    from s2a_bench.types import Frame, Piece, Request

PAYLOADS: Final = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
"""How a picture travels: ``bgr8`` pixels, the camera's own YUYV, JPEG, a JPEG that was at hand before, PNG."""

LOSSLESS: Final = frozenset({"", "raw", "yuyv", "png"})
"""Payloads after which the engine sees the camera's very pixels; "" where nothing travels."""

TRANSPORT: Final = "Transport"
"""The heading in ``--help`` over options that say how requests travel."""

SERVER: Final = "server"
"""``side`` of an option that the server's process is told too: cells that differ in it get servers of their own."""

SERVING: Final = "serving"
"""``side`` of such an option that is a flag of `serve` only; a run has it in the name of a pipeline."""

EXTERNAL: Final = "external"
"""``side`` of an option that, when set, is the address of a server that runs already and is not ours."""

PROGRAM: Final = "program"
"""``side`` of an option that names an external server for the run to start: see `TransportOptions.program`."""


Payload = Annotated[str, base.one_of(lambda: ("", *PAYLOADS))]
"""One of `PAYLOADS`, or nothing."""
Payloads = Annotated[tuple[Payload, ...], base.SEVERAL]


@dataclass(frozen=True, slots=True)
class Program:
    """Somebody else's server that a run starts on its own model files: its kind, the program, its port (0: any)."""

    kind: str
    path: Path
    port: int


class TransportOptions(base.Options):
    """What every transport can be told; a transport without options of its own uses this class.

    An option is the client's business unless its ``side`` says something else.
    """

    PANEL: ClassVar[str] = TRANSPORT
    SERVE_DEFAULTS: ClassVar[Mapping[str, Any]] = {}
    """Values that options have in `serve` unless told."""
    NOT_SERVE_FLAGS: ClassVar[tuple[str, ...]] = ()
    """Options that `serve` takes in the pipeline's name, its file or ``--ros-args``, and has no flag for."""

    payload: Payload = base.option("", f"how a picture travels: {', '.join(PAYLOADS)} [default: raw where it can]")

    @classmethod
    def of_sides(cls, *sides: str) -> list[str]:
        """Return the options of one of these sides, "" the client's."""
        fields = cls.model_fields.items()
        return [name for name, field in fields if str(base.extra_of(field).get("side", "")) in sides]

    @property
    def external(self) -> str:
        """Return the option that says that the server is not ours, or nothing."""
        return next((name for name in self.of_sides(EXTERNAL, PROGRAM) if getattr(self, name)), "")

    @property
    def external_address(self) -> str:
        """Return the address of a server that runs already, or nothing."""
        return next((getattr(self, name) for name in self.of_sides(EXTERNAL)), "")

    @property
    def program(self) -> Program | None:
        """Return somebody else's server that the run should start, if that is wanted."""
        return None

    @property
    def tuned(self) -> bool:
        """Whether processes keep large blocks of memory for the next picture, and what else makes it faster."""
        return True

    @property
    def against_loss(self) -> str:
        """Return what to do where pictures or messages are lost on the way."""
        return "look at the network"

    def addresses(self) -> Iterable[str]:
        """Return what a new server of ours may bind: the first that no other has, else the last."""
        return ("",)


O = TypeVar("O", bound=TransportOptions)  # noqa: E741 - the one type variable here

TOKENS: Final = "tokens"
ACTIONS: Final = "actions"

TOKEN_S: Final = 5.0
"""Of a deadline that nobody set, for each token; far slower than any model that a robot could wait for."""

Handler: TypeAlias = "Callable[[Request, Trace], Generator[Piece, None, None]]"
"""What a server does with a request whose pictures are ``rgb8``: it yields tokens, or actions, and marks the trace.

A handler marks `queue` if it waited for a free engine, `inference` at the first piece, and appends the time of
every piece to ``trace.token_ns``. Transports know handlers, never engines.
"""


class CameraSink(Protocol):
    """Where a running camera's frames go when the server is to keep the newest itself (stream mode)."""

    def stamp_ns(self, frame: Frame) -> int:
        """Return the ROS-time stamp that will name this frame in the server's marks."""
        ...

    def publish(self, frame: Frame, trace: Trace) -> None:
        """Convert, pack and send one frame, marking each stage."""
        ...


class Client(Protocol):
    """One side of one pipeline. Not thread-safe; one request at a time."""

    @property
    def camera(self) -> CameraSink | None:
        """None where the newest frame goes with the prompt instead. The first use may wait for the server."""
        ...

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        """Send a request with its frames as captured, yield pieces as they arrive, mark every stage.

        After the last piece ``trace.remote`` holds the server's marks. Raises RequestFailed when the server
        refuses or breaks off, or goes beyond what `transport.limits` allows, ServerDied when it is gone.
        """
        ...

    def describe(self) -> dict[str, str]:
        """Return how the server is asked, as far as the wiring does not tell, for the manifest."""
        ...

    def close(self) -> None:
        """Close connections; may be called twice."""
        ...


class Server(Protocol):
    """Receives requests, hands each to a handler and sends back what that yields."""

    address: str
    """Where a client of the same transport finds it, known once the server exists."""

    def describe(self) -> dict[str, str | int]:
        """Return what carries the requests, for the manifest."""
        ...

    def serve(self) -> None:
        """Serve until `stop` is called from another thread or a signal handler."""
        ...

    def stop(self) -> None:
        """Make `serve` return soon; may be called twice, from any thread."""
        ...


@dataclass(frozen=True, slots=True)
class Wiring(Generic[O]):
    """What a client, or the process of a server, is told: one pipeline and where its other end is."""

    transport: str
    variant: str
    options: O
    """``options.payload`` is what travels, the transport's default filled in."""
    address: str = ""
    """A client: where the server is. A server: what it should bind, or the address that it had; empty: any."""
    black_box: bool = False
    """Whether the server is not ours, so that it sends no marks."""
    timeout_s: float = 300.0
    """The longest silence before a request counts as failed."""
    deadline_s: float = 0.0
    """The longest that a whole answer may take; 0: see `deadline_of`."""
    max_tokens: int = 512
    """The most tokens of a request that cannot say itself how many it wants."""
    limits: Limits = LIMITS
    """What a server takes."""
    restarted: bool = False
    """Whether a server takes the place of one that died, and of which the network may not know yet."""

    def to_json(self) -> dict[str, Any]:
        """Return it as plain data."""
        told = {name: getattr(self, name) for name in ("transport", "variant", "address", "black_box", "restarted")}
        told |= {"timeout_s": self.timeout_s, "deadline_s": self.deadline_s, "max_tokens": self.max_tokens}
        return {**told, "options": self.options.model_dump(mode="json"), "limits": self.limits.to_manifest()}

    @property
    def capabilities(self) -> Capabilities[O]:
        """Return what the pipeline can carry."""
        return TRANSPORTS[self.transport].capabilities(Choice(self.options, self.variant))

    def deadline_of(self, max_tokens: int) -> float:
        """Return the seconds that an answer of so many tokens may take: as told, else generous for that many."""
        return self.deadline_s or self.timeout_s + TOKEN_S * max_tokens

    @staticmethod
    def from_json(told: Mapping[str, Any]) -> Wiring[Any]:
        """Read what `to_json` returned."""
        options = TRANSPORTS[told["transport"]].options.model_validate(told["options"])
        return Wiring(**{**told, "options": options, "limits": Limits(**told["limits"])})


@dataclass(frozen=True, slots=True)
class Choice(Generic[O]):
    """What is chosen of a transport, by the name of a pipeline and the settings of a run."""

    options: O
    variant: str = ""
    mode: str = ""
    engine: str = ""
    cameras: int = 1
    """Pictures a request."""


@dataclass(frozen=True, slots=True)
class Capabilities(Generic[O]):
    """What a choice can carry."""

    options: O
    """As they hold for the variant."""
    payloads: tuple[str, ...]
    """How pictures can travel; the first is taken where raw cannot."""
    answer_kinds: tuple[str, ...]
    """What answers can be made of: tokens, actions."""
    accepts_state: bool
    """Whether a request can carry the robot's state."""
    facts: Sequence[Fact]
    """Those that may be told, by somebody else's server too."""
    server: str = ""
    """Which of the transport's servers answers the variant."""


@dataclass(frozen=True, slots=True)
class Urls:
    """The URLs that name a server of a transport's kind which is not ours; its option `url` takes them."""

    schemes: tuple[str, ...] = ()
    examine: str = ""
    """``module:function`` of what `doctor --url` looks at, see `transport.risks`."""
    cache_hits: str = ""
    """``module:function`` that returns counter -> hits of its caches that the server of a wiring has counted so far."""


class Transport(Generic[O]):
    """One way to travel, and all that is said about it; subclass it, and make one instance."""

    name: ClassVar[str] = ""
    options: type[O]
    """The model of its options."""
    variants: ClassVar[tuple[str, ...]] = ()
    """What follows its name, as ``http/binary``; the first is measured unless told."""
    payloads: ClassVar[tuple[str, ...]] = ()
    """How pictures can travel; the first is taken where raw cannot. Nothing where they do not travel at all."""
    answer_kinds: ClassVar[tuple[str, ...]] = (TOKENS,)
    """What answers can be made of: tokens, actions."""
    accepts_state: ClassVar[bool] = False
    """Whether a request can carry the robot's state."""
    stages: ClassVar[Mapping[str, str]] = {}
    """Stage -> group (one of `trace.GROUPS`), those of `trace.STAGES` left out."""
    facts: ClassVar[Sequence[Fact]] = ()
    """Those that its client and server tell, without those of the handler."""
    order: ClassVar[float] = 50
    """How its cells sort among others."""
    style: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """Variant ("" for none) -> colour and line style, in every figure."""
    compared_with: ClassVar[tuple[str, ...]] = ("loopback",)
    """The transports by whose cells its own are divided."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Python packages whose versions belong beside its results."""
    checks: ClassVar[Mapping[str, str]] = {}
    """Code -> ``module:function`` of the doctor's checks that are about it."""
    udp_checks: ClassVar[tuple[str, ...]] = ()
    """Codes of those that matter before a run with large pictures, where it sends UDP packets, which can be lost."""
    in_process: ClassVar[bool] = False
    """Whether its server is a thread of the client's process."""
    urls: ClassVar[Urls] = Urls()

    def client(self, wiring: Wiring[O], alive: Callable[[], bool]) -> Client:
        """Connect to the server at ``wiring.address``; ``alive`` tells whether its process still runs."""
        raise NotImplementedError

    def server(self, wiring: Wiring[O], handler: Handler) -> Server:
        """Bind a server, ready to `serve`; raises PortInUse or TransportError."""
        raise NotImplementedError

    def measured(self, choice: Choice[O]) -> Sequence[str]:  # noqa: ARG002 - for those whose variants depend on it
        """Return the variants to measure where the pipeline names none."""
        return self.variants[:1] or ("",)

    def capabilities(self, choice: Choice[O]) -> Capabilities[O]:
        """Return what a variant can carry with its options."""
        return Capabilities(choice.options, self.payloads, self.answer_kinds, self.accepts_state, self.facts)

    def require(self, choice: Choice[O]) -> None:
        """Raise UsageError for options that do not go together with the rest of a choice, or with this machine."""

    def ready(self, wiring: Wiring[O]) -> str:
        """Return what `serve` says once the server is bound, at ``wiring.address``."""
        return f"serving {wiring.transport} at {wiring.address}"


TRANSPORTS: Final[Registry[Transport[Any]]] = Registry(
    "transports",
    "transport",
    {
        "http": "s2a_bench.transport.http:HTTP",
        "ros": "s2a_bench.transport.ros:ROS",
        "loopback": "s2a_bench.transport.loopback:LOOPBACK",
        "shm": "s2a_bench.transport.shm:SHM",
        "websocket": "s2a_bench.transport.websocket:WEBSOCKET",
        "zmq": "s2a_bench.transport.zmq:ZMQ",
    },
)
"""Name -> what is said about it."""


class _UndeclaredTransport(Transport[TransportOptions]):
    """What is assumed of a transport of an old run whose package is not here."""

    options = TransportOptions
    order = inf


@cache
def declared_transport(name: str) -> Transport[Any]:
    """Return what is said about a transport, for showing a run; one that is not installed is like any other."""
    try:
        return TRANSPORTS[name]
    except UsageError:
        return _UndeclaredTransport()


def paths() -> Iterator[str]:
    """Yield what the name of a pipeline may begin with: every transport, and its variants as TRANSPORT/VARIANT."""
    for name, transport in TRANSPORTS.loaded():
        yield from (name, *(f"{name}/{variant}" for variant in transport.variants))


def named_by(url: str) -> str:
    """Return the transport that a URL's scheme names; raises UsageError where none does.

    It is ``http`` for a text without a scheme, of which its options say what is wrong.
    """
    scheme, mark, _ = url.partition("://")
    known = {scheme: name for name, each in TRANSPORTS.loaded() for scheme in each.urls.schemes}
    if mark and scheme.lower() not in known:
        raise UsageError(
            f"`url`: no transport here speaks {scheme}://, only {', '.join(f'{each}://' for each in known)}"
        )
    return known.get(scheme.lower(), "http")


def open_client(wiring: Wiring[Any], alive: Callable[[], bool] = lambda: True) -> Client:
    """Connect to the server of a wiring; ``alive`` tells whether its process still runs."""
    return TRANSPORTS[wiring.transport].client(wiring, alive)


def open_server(wiring: Wiring[Any], handler: Handler) -> Server:
    """Bind a server, ready to `serve`; raises PortInUse or TransportError."""
    return TRANSPORTS[wiring.transport].server(wiring, handler)
