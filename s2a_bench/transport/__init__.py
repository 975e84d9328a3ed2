"""How pictures and tokens travel: a Client sends one request and yields tokens, a Server feeds a Handler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol, TypeAlias

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
