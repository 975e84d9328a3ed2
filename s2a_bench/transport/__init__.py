"""How pictures and tokens travel: a Client sends one request and yields tokens, a Server feeds a Handler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Protocol, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.trace import Trace
from s2a_bench.types import Request, Token

Handler: TypeAlias = Callable[[Request, Trace], Iterator[Token]]
"""What a server does with a request whose pictures are ``rgb8``: it yields tokens and marks the trace.

A handler marks `queue` if it waited for a free engine, `inference` at the first token, and appends the time of
every token to ``trace.token_ns``. Transports know handlers, never engines.
"""


class Client(Protocol):
    """One side of one pipeline. Not thread-safe; one request at a time."""

    def request(self, request: Request, trace: Trace) -> Iterator[Token]:
        """Send a request with its frames as captured, yield tokens as they arrive, mark every stage.

        After the last token ``trace.remote`` holds the server's marks. Raises RequestFailed when the server
        refuses or breaks off, ServerDied when it is gone.
        """
        ...

    def close(self) -> None:
        """Close connections; may be called twice."""
        ...


class Server(Protocol):
    """Receives requests, hands each to a handler and sends back what that yields."""

    address: str
    """Where a client of the same transport finds it, known once the server exists."""

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
    """http: the server is not ours, so it sends no marks."""
    model: str = "s2a"
    """http: the model's name in the request."""
    dds_tuning: str = "tuned"
    domain_id: int = 0
    timeout_s: float = 300.0
    """The longest silence before a request counts as failed."""


TRANSPORTS: dict[str, tuple[str, str]] = {
    "http": ("s2a_bench.transport.http.client:HttpClient", "s2a_bench.transport.http.server:HttpServer"),
    "ros": ("s2a_bench.transport.ros.topic:TopicClient", "s2a_bench.transport.ros.topic:TopicServer"),
    "loopback": ("s2a_bench.transport.loopback:LoopbackClient", "s2a_bench.transport.loopback:LoopbackServer"),
}
"""Name -> (client class, built as ``Client(route, alive)``; server class, built as ``Server(route, handler)``)."""


def _implementation(route: Route, side: int) -> Callable[..., object]:
    if route.transport not in TRANSPORTS:
        raise UsageError(f"--transport: '{route.transport}' is none of {', '.join(TRANSPORTS)}")
    found: Callable[..., object] = resolve_name(TRANSPORTS[route.transport][side])
    return found


def open_client(route: Route, alive: Callable[[], bool] = lambda: True) -> Client:
    """Connect to the server of a route; ``alive`` tells whether its process still runs."""
    return _implementation(route, 0)(route, alive)  # type: ignore[return-value]


def open_server(route: Route, handler: Handler) -> Server:
    """Bind a server, ready to `serve`; raises PortInUse or TransportError."""
    return _implementation(route, 1)(route, handler)  # type: ignore[return-value]
