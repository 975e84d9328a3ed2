"""ROS 2 without a ROS install: a Middleware publishes and subscribes under ROS 2 names and types.

Messages are instances of the rosbags classes in `s2a_bench.ros.messages`, whatever the implementation sends.
Packing and sending are two calls, and so are taking and unpacking, because the harness times them apart.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pkgutil import resolve_name
from typing import Any, Final, Literal, Protocol, TypeAlias

from s2a_bench.errors import TransportError
from s2a_bench.extras import how_to_install
from s2a_bench.registry import Registry
from s2a_bench.ros import config

Tuning: TypeAlias = Literal["tuned", "default"]


@dataclass(frozen=True, slots=True)
class QoS:
    """The quality of service settings ROS 2 users know; `depth` 0 keeps all, `latched` is transient local.

    A message older than ``lifespan_s`` is not delivered any more; 0: however old.
    """

    depth: int = 10
    reliable: bool = True
    latched: bool = False
    lifespan_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Offer:
    """A publisher of any process: its absolute topic, its ROS type, and whether it offers reliable delivery."""

    topic: str
    type_name: str
    reliable: bool


class Publisher(Protocol):
    def pack(self, message: Any) -> Any:
        """Serialise a message into what `send` takes."""

    def send(self, packed: Any) -> None:
        """Hand a packed message to the middleware; raises TransportError."""

    def matched(self) -> int:
        """Count the subscriptions this publisher reaches."""


class Subscription(Protocol):
    """Receives messages of one type from one topic, on the thread that calls `take`."""

    topic: str
    """Its absolute ROS name, after remapping."""

    def take(self, timeout_s: float) -> Any | None:
        """Wait for the next message and return it packed; None on timeout or after `interrupt`."""

    def unpack(self, packed: Any) -> Any:
        """Deserialise; arrays may be read-only views of the received buffer. Raises TransportError."""

    def sender(self) -> Any:
        """Return a hashable name of the publisher of what `take` returned last; for the thread that takes."""

    def sender_hears(self, sender: Any, publisher: Any) -> bool:
        """Return whether ``publisher``, of the same node as this, reaches a subscription beside ``sender``.

        True where that cannot be known, and once the sender has left; callable from any thread.
        """

    def interrupt(self) -> None:
        """Make a blocked `take`, and every later one, return None; callable from any thread."""

    def matched(self) -> int:
        """Count the publishers that reach this subscription."""


@dataclass(frozen=True, slots=True)
class Accepted:
    """The server accepted the goal; the client has requested its result."""

    goal_id: bytes


@dataclass(frozen=True, slots=True)
class Rejected:
    """The server refused the goal; nothing more comes."""

    goal_id: bytes


@dataclass(frozen=True, slots=True)
class Feedback:
    goal_id: bytes
    packed: Any


@dataclass(frozen=True, slots=True)
class Result:
    """The end of a goal: ``status`` is an `action.Status`, UNKNOWN (0) for a goal the server does not know."""

    goal_id: bytes
    status: int
    packed: Any


ActionEvent: TypeAlias = "Accepted | Rejected | Feedback | Result"


class ActionClient(Protocol):
    """Sends goals to one action; one thread takes the events, any thread may send and cancel."""

    def wait_for_server(self, timeout_s: float) -> bool:
        """Wait until a whole server is matched; False on timeout."""

    def server_present(self) -> bool:
        """Return whether a whole server is matched now."""

    def other_dds(self) -> str:
        """Return the DDS of a server that is present but incompatible, else ""."""

    def server_version(self) -> str | None:
        """Return the interface version whose type hash the server announces; None if it announces none.

        Raises TransportError when the hash is that of no known version.
        """

    def pack(self, goal: Any) -> Any:
        """Serialise a goal into what `send` takes."""

    def send(self, packed: Any, goal_id: bytes | None = None) -> bytes:
        """Send a goal under a new id, or under ``goal_id`` (16 bytes), and return the id."""

    def next_event(self, timeout_s: float) -> ActionEvent | None:
        """Wait for the next event of any goal of this client; None on timeout or after `interrupt`.

        A goal's events come in the order Accepted, Feedback ..., Result.
        """

    def unpack_feedback(self, packed: Any) -> Any:
        """Deserialise `Feedback.packed` into the action's feedback; raises TransportError."""

    def unpack_result(self, packed: Any) -> Any:
        """Deserialise `Result.packed` into the action's result; raises TransportError."""

    def cancel(self, goal_id: bytes) -> None:
        """Ask to cancel a goal; its result says whether it was."""

    def get_result(self, goal_id: bytes) -> None:
        """Ask for a result (again); after acceptance this happens by itself."""

    def interrupt(self) -> None:
        """Make a blocked `next_event`, and every later one, return None; callable from any thread."""


class ServerGoal(Protocol):
    """A goal on the server, callable from any thread; TransportError for a step its state does not allow."""

    id: bytes
    """Its 16 bytes."""

    @property
    def size_bytes(self) -> int:
        """Return the size of its request: the CDR, or its texts and pixels where the middleware keeps no CDR."""

    @property
    def cancel_requested(self) -> bool:
        """Return True once a client has requested a cancel."""

    def other_version(self) -> str:
        """Return the version of llama_msgs that its client announces, where that is known and not the server's."""

    def unpack(self) -> Any:
        """Deserialise the goal; arrays may be views of the received buffer. Raises TransportError."""

    def accept(self) -> None:
        """Accept the goal: reply to the client, then publish the status."""

    def reject(self) -> None:
        """Reject the goal: reply to the client and keep nothing."""

    def executing(self) -> bool:
        """Start; False if a cancel came first (then end it with `canceled`)."""

    def feedback(self, message: Any) -> None: ...

    def succeed(self, result: Any) -> None: ...

    def abort(self, result: Any) -> None: ...

    def canceled(self, result: Any) -> None:
        """End the goal as CANCELED; only after a cancel was requested."""


class ActionServer(Protocol):
    """Offers one action; cancels and results are served by a thread of its own."""

    version: str
    """The version of llama_msgs, one of `messages.VERSIONS`."""

    def next_goal(self, timeout_s: float) -> ServerGoal | None:
        """Wait for the next goal, to accept or reject; None on timeout or after `interrupt`. One thread at a time."""

    def interrupt(self) -> None:
        """Make a blocked `next_goal`, and every later one, return None; callable from any thread."""


class ServiceClient(Protocol):
    """Calls one service; one thread at a time."""

    def call(self, request: Any, timeout_s: float) -> Any:
        """Wait for the server, send a request and return the response; raises TransportError where none comes."""


SERVICE_QOS = QoS(depth=10)
"""The QoS of ROS's services."""


class Middleware(Protocol):
    def publisher(self, topic: str, type_name: str, qos: QoS) -> Publisher:
        """Publish messages of ROS type ``pkg/msg/Name`` on the absolute ROS topic name ``/x``."""

    def subscription(self, topic: str, type_name: str, qos: QoS) -> Subscription:
        """Subscribe to the absolute ROS topic name ``/x``."""

    def offers(self) -> list[Offer]:
        """Return all publishers that are known by now; those of other processes appear within a second or so.

        Callable from any thread.
        """

    def service(self, name: str, type_name: str, answer: Callable[[Any], Any], qos: QoS = SERVICE_QOS) -> None:
        """Offer the service ``/x`` of ROS type ``pkg/srv/Name``; ``answer`` turns a request into its response.

        All services of a node are answered by one thread of the middleware. A request that cannot be read, or for
        which ``answer`` raises, is dropped and logged.
        """

    def service_client(self, name: str, type_name: str) -> ServiceClient: ...

    def action_client(self, name: str, type_name: str, version: str = "6.0") -> ActionClient:
        """Call the action ``/x`` of ROS type ``pkg/action/Name``; ``version`` as in `messages.VERSIONS`."""

    def action_server(
        self, name: str, type_name: str, result_timeout_s: float = 60.0, version: str = ""
    ) -> ActionServer:
        """Offer the action ``/x``; results are kept for ``result_timeout_s`` after a goal ended.

        Without a ``version`` it is the one that the workspace has built, 6.0 where there is no workspace.
        """

    def describe(self) -> dict[str, str | int]:
        """Return the facts of the middleware: implementation, version, domain, configuration."""

    def close(self) -> None:
        """Leave the domain at once, so that peers need not wait for the lease; may be called twice."""


@dataclass(frozen=True, slots=True)
class MeetingPlace:
    """The meeting place of a middleware whose nodes do not find each other; an option or parameter names it."""

    option: str
    about: str
    """The option's help."""
    title: str
    """Its name in a sentence."""
    default: str
    check: Callable[[str], object]
    """Raises UsageError for a text that names no place."""
    to_host: Callable[[str], str]
    """Returns the place that a new server is itself, from what the option says; "" if it joins one that is there."""


@dataclass(frozen=True, slots=True)
class MiddlewareKind:
    """The declaration of a middleware, which is also read where its packages are not installed."""

    opens: str
    """``module:class``, built as ``Class(domain_id, tuning, node_name)``; with a `meeting_place` that and whether this
    node hosts it follow."""
    module: str
    """The top-level module without which it is not installed."""
    way_out: str
    """The advice for a middleware that is not installed, beside choosing another."""
    dds: str
    """The carrier of its messages: an RMW or its own name; empty for the library of a sourced ROS 2, which has one."""
    meeting_place: MeetingPlace | None = None
    against_loss: str = ""
    """The advice for lost messages; empty for UDP datagrams, for which the DDS in use has one."""
    extra: str = ""
    """The extra of s2a-bench that installs it."""
    packages: tuple[str, ...] = ()
    checks: Mapping[str, str] = field(default_factory=dict)
    """The same as `Transport.checks`; ``packages`` too."""
    has_action: str = ""
    """``module:function`` that returns whether an action's type is built, where types come from a workspace."""

    def dds_in(self, environ: Mapping[str, str]) -> str:
        return self.dds or environ.get("RMW_IMPLEMENTATION") or config.DEFAULT_RMW

    def place_in(self, options: object) -> str:
        """Return its meeting place as options or parameters name it; "" if they do not, or if it has none."""
        return str(getattr(options, self.meeting_place.option)) if self.meeting_place else ""

    def builds(self, action: str) -> bool:
        return not self.has_action or bool(resolve_name(self.has_action)(action))


CYCLONEDDS = MiddlewareKind(
    "s2a_bench.ros.cyclone:CycloneMiddleware",
    "cyclonedds",
    "it has wheels for x86-64 only: elsewhere source a ROS 2 (/opt/ros/<distribution>/setup.bash), "
    "or leave ros out of --transport",
    config.CYCLONE,
    packages=("cyclonedds",),
)
MIDDLEWARES: Final[Registry[MiddlewareKind]] = Registry(
    "middlewares", "middleware", {"cyclonedds": "s2a_bench.ros:CYCLONEDDS"}
)


def default_middleware(environ: Mapping[str, str]) -> str:
    """Choose the client library of a sourced ROS 2 that has it for this Python, else the first that is installed."""
    sourced = environ.get("ROS_DISTRO") and environ.get("AMENT_PREFIX_PATH")
    kinds = {name: kind for name, kind in MIDDLEWARES.loaded() if (kind.dds or sourced) and find_spec(kind.module)}
    return min(kinds, key=lambda name: bool(kinds[name].dds), default=next(iter(MIDDLEWARES)))


def middleware_kind(name: str = "") -> MiddlewareKind:
    """Return the middleware of a name, `default_middleware` without; raises UsageError."""
    return MIDDLEWARES[name or default_middleware(os.environ)]


def way_out(kind: MiddlewareKind) -> str:
    """Return the way out where a middleware is not installed: also each other one that pip installs."""
    extras = {name: other.extra for name, other in MIDDLEWARES.loaded() if other != kind and other.extra}
    others = (f"--middleware {name} ({how_to_install(extra)})" for name, extra in extras.items())
    return ", or ".join((kind.way_out, *others))


def loss_advice(dds: str) -> str:
    """Return the advice against loss of the middleware that speaks like ``dds``; "" for datagrams."""
    return next((kind.against_loss for _, kind in MIDDLEWARES.loaded() if kind.dds == dds), "")


def open_middleware(
    name: str = "",
    *,
    domain_id: int | None = None,
    tuning: Tuning = "tuned",
    node_name: str = "/s2a_bench",
    place: str = "",
    host: bool = False,
) -> Middleware:
    """Join a ROS 2 domain as the node ``node_name``, its namespace included; `default_middleware` without a name.

    Without ``domain_id`` the domain is ROS_DOMAIN_ID, else 0. Nodes of a middleware with a `MeetingPlace` meet at
    ``place``, or its default; as ``host`` this node is that place.

    Raises UsageError for an unknown name or domain, TransportError when the domain cannot be joined.
    """
    name = name or default_middleware(os.environ)
    kind = MIDDLEWARES[name]
    try:
        implementation: Callable[..., Middleware] = resolve_name(kind.opens)
    except ModuleNotFoundError as error:
        way = f"{way_out(kind)}; of a source, robot or ego with ?middleware="
        raise TransportError(f"middleware {name} is not installed ({error}); {way}") from error
    domain = config.domain_id(os.environ, domain_id)
    if kind.meeting_place is None:
        return implementation(domain, tuning, node_name)
    return implementation(domain, tuning, node_name, place or kind.meeting_place.default, host)
