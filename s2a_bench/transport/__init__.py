"""How pictures and tokens travel: a Client sends one request and yields tokens, a Server feeds a Handler."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Protocol, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.trace import Trace
from s2a_bench.types import Frame, Request, Token

HTTP_VARIANTS = ("as-deployed", "best-effort", "binary")
ROS_VARIANTS = ("topic", "action")
PAYLOADS = ("jpeg", "jpeg-preencoded", "png", "raw")
WIRES = ("bgr", "yuyv", "compressed")
QOS_PROFILES = ("reliable", "sensor_data")
CONNECTIONS = ("keep-alive", "per-request", "client-per-request")

Handler: TypeAlias = Callable[[Request, Trace], Generator[Token, None, None]]
"""What a server does with a request whose pictures are ``rgb8``: it yields tokens and marks the trace.

A handler marks `queue` if it waited for a free engine, `inference` at the first token, and appends the time of
every token to ``trace.token_ns``. Transports know handlers, never engines.
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

    camera: CameraSink | None
    """None where the newest frame goes with the prompt instead."""

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Send a request with its frames as captured, yield tokens as they arrive, mark every stage.

        After the last token ``trace.remote`` holds the server's marks. Raises RequestFailed when the server
        refuses or breaks off, ServerDied when it is gone.
        """
        ...

    def describe(self) -> dict[str, str]:
        """Say how the server is asked, as far as the route does not tell, for the manifest."""
        ...

    def close(self) -> None:
        """Close connections; may be called twice."""
        ...


class Server(Protocol):
    """Receives requests, hands each to a handler and sends back what that yields."""

    address: str
    """Where a client of the same transport finds it, known once the server exists."""

    def describe(self) -> dict[str, str | int]:
        """Say what carries the requests, for the manifest."""
        ...

    def serve(self) -> None:
        """Serve until `stop` is called from another thread or a signal handler."""
        ...

    def stop(self) -> None:
        """Make `serve` return soon; may be called twice, from any thread."""
        ...


@dataclass(frozen=True, slots=True)
class Route:
    """How one pipeline is wired; plain data, so that a server process can be told."""

    transport: str
    variant: str = ""
    """http: as-deployed, best-effort, binary; ros: topic; loopback has none."""
    address: str = ""
    """http: base URL (server: ``host:port``, port 0 for any); ros: namespace of the topics."""
    payload: str = "jpeg"
    """http: how a picture travels: jpeg, jpeg-preencoded, png, raw."""
    wire: str = "bgr"
    """ros: how a picture travels: bgr, yuyv, compressed."""
    connection: str = "keep-alive"
    """http: keep-alive, per-request (a new connection), client-per-request (a new client object)."""
    black_box: bool = False
    """The server is not ours, so it sends no marks."""
    model: str = "default"
    """http: the model's name in the request."""
    dialect: str = ""
    """http: what a black box speaks, a name of ``http.dialects.DIALECTS``; empty: ask which OpenAI server it is."""
    api_key_env: str = ""
    """http: the environment variable that holds a black box's API key."""
    extra_body: str = ""
    """http: JSON that is merged into every request's body (RFC 7396)."""
    middleware: str = ""
    """ros: cyclonedds or rclpy; empty: rclpy in a sourced ROS 2 environment, else cyclonedds."""
    qos: str = "reliable"
    """ros: the camera's quality of service, by its ROS 2 profile: reliable, sensor_data."""
    dds_tuning: str = "tuned"
    domain_id: int = 0
    action: str = ""
    """ros client: the full name of an action that is not under the namespace, as of a llama_ros node."""
    max_tokens: int = 512
    """ros server: the most tokens of a goal, which cannot say itself how many it wants."""
    result_timeout_s: float = 60.0
    """ros server: how long a goal's result is kept."""
    feedback_interval_s: float = 0.0
    """ros server: the least time between two feedbacks; tokens that come faster share one. 0: a feedback a token."""
    publish_tokens: bool = False
    """ros server: whether the tokens of goals also go to the topic ``token``, for plotting."""
    timeout_s: float = 300.0
    """The longest silence before a request counts as failed."""


TRANSPORTS: dict[str, tuple[str, str]] = {
    "http": ("s2a_bench.transport.http.client:HttpClient", "s2a_bench.transport.http.server:HttpServer"),
    "ros/topic": ("s2a_bench.transport.ros.topic:TopicClient", "s2a_bench.transport.ros.server:RosServer"),
    "ros/action": ("s2a_bench.transport.ros.action:GenerateClient", "s2a_bench.transport.ros.server:RosServer"),
    "loopback": ("s2a_bench.transport.loopback:LoopbackClient", "s2a_bench.transport.loopback:LoopbackServer"),
}
"""Transport or transport/variant -> (client class, built as ``Client(route, alive)``; server class, built as
``Server(route, handler)``)."""

NAMES = tuple(dict.fromkeys(name.partition("/")[0] for name in TRANSPORTS))
"""The transports, without their variants."""


def _implementation(route: Route, side: int) -> Callable[..., object]:
    for name in (f"{route.transport}/{route.variant}", route.transport):
        if name in TRANSPORTS:
            found: Callable[..., object] = resolve_name(TRANSPORTS[name][side])
            return found
    raise UsageError(f"--transport: '{route.transport}' is none of {', '.join(NAMES)}")


def open_client(route: Route, alive: Callable[[], bool] = lambda: True) -> Client:
    """Connect to the server of a route; ``alive`` tells whether its process still runs."""
    return _implementation(route, 0)(route, alive)  # type: ignore[return-value]


def open_server(route: Route, handler: Handler) -> Server:
    """Bind a server, ready to `serve`; raises PortInUse or TransportError."""
    return _implementation(route, 1)(route, handler)  # type: ignore[return-value]
