"""The client of a policy server: makes the observation of each request, and counts the actions of its answer."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, Final, Generic

from s2a_bench.errors import RequestFailed
from s2a_bench.frames.convert import to_rgb
from s2a_bench.plugins.policy_servers.observation import Template
from s2a_bench.plugins.policy_servers.policies import P
from s2a_bench.secrets import struck
from s2a_bench.trace import Trace
from s2a_bench.transport import TRANSPORTS, Client, Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.pictures import encoded
from s2a_bench.types import Frame, Piece, Pixels, Request

QUOTED: Final = 500
"""Letters shown of a server's error: its end, as a traceback's reason comes last."""


def policy_picture(frame: Frame, payload: str, trace: Trace) -> Pixels:
    """Return a picture for a policy: (H, W, 3) RGB, or a file's (n,) bytes; marks as `encoded` does."""
    if payload != "raw":
        return encoded(frame, payload, trace)[1].reshape(-1)
    if frame.encoding == "rgb8":
        return frame.data
    data = to_rgb(frame)
    trace.mark("convert")
    return data


class PolicyClient(Client, Generic[P]):
    _connection: Any = None
    """The connection, where there is one."""

    def __init__(self, wiring: Wiring[P], alive: Callable[[], bool]) -> None:
        self._wiring, self._alive = wiring, alive
        self._native = not wiring.black_box
        declared: Any = TRANSPORTS[wiring.transport]
        self._template: Template = declared.template(wiring.options)
        self._url = wiring.address
        self._listed: list[str] = []

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        bounds = self._wiring.bounds(self._url, request.max_tokens)
        try:
            yield from self._answer(request, bounds, trace)
        except BaseException:
            self._abandon()
            raise

    @abstractmethod
    def _answer(self, request: Request, bounds: Bounds, trace: Trace) -> Iterator[Piece]:
        """Send the request and yield its actions; after the last, complete the trace."""

    def _abandon(self) -> None:
        """Give up the connection, whose answer is incomplete."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def close(self) -> None:
        self._abandon()

    def _observation(self, request: Request, trace: Trace) -> dict[str, Any]:
        pictures = [self._picture(frame, place, trace) for place, frame in enumerate(request.images)]
        return self._template.fill(pictures, request.state, request.prompt, self._listed)

    def _picture(self, frame: Frame, place: int, trace: Trace) -> Pixels:  # noqa: ARG002 - for those that keep memory
        return policy_picture(frame, self._wiring.options.payload, trace)

    def _failed(self, text: str, retry_after_s: float | None = None) -> RequestFailed:
        """Return the error that a server describes with ``text``."""
        reason = " ".join(struck(text).split())[-QUOTED:] or "an error without words"
        return RequestFailed(f"{self._url}: {reason}", retry_after_s=retry_after_s)

    def describe(self) -> dict[str, str]:
        return {"url": self._url, "template": self._template.name}
