"""The client of a policy server: makes the observation of each request, and counts the actions of its answer."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, Final, Generic

from s2a_bench.errors import RequestFailed
from s2a_bench.secrets import struck
from s2a_bench.trace import Trace
from s2a_bench.transport import Client, Wiring
from s2a_bench.transport.limits import Bounds
from s2a_bench.transport.observation import template_of
from s2a_bench.transport.pictures import policy_picture
from s2a_bench.transport.policies import P
from s2a_bench.types import Frame, Piece, Pixels, Request

QUOTED: Final = 500
"""Letters shown of a server's error: its end, as a traceback's reason comes last."""


class PolicyClient(Client, Generic[P]):
    def __init__(self, wiring: Wiring[P], alive: Callable[[], bool]) -> None:
        self._wiring, self._alive = wiring, alive
        self._native = not wiring.black_box
        self._template = template_of(wiring.options.template_name)
        self._url = wiring.address
        self._listed: list[str] = []

    def request(self, request: Request, trace: Trace) -> Iterator[Piece]:
        bounds = self._bounds(request.max_tokens)
        try:
            for piece in self._answer(request, bounds, trace):
                bounds.count_piece()
                yield piece
        except BaseException:
            self._abandon()
            raise

    @abstractmethod
    def _answer(self, request: Request, bounds: Bounds, trace: Trace) -> Iterator[Piece]:
        """Send the request and yield its actions; after the last, complete the trace."""

    def _abandon(self) -> None:
        """Give up the connection, whose answer is incomplete."""
        self.close()

    def _bounds(self, max_tokens: int) -> Bounds:
        return Bounds(self._url, self._wiring.deadline_of(max_tokens), max_tokens)

    def _observation(self, request: Request, trace: Trace) -> dict[str, Any]:
        """Fill the template, marking the stages of each picture."""
        pictures = [self._picture(frame, place, trace) for place, frame in enumerate(request.images)]
        return self._template.fill(pictures, request.state, request.prompt, self._listed)

    def _picture(self, frame: Frame, place: int, trace: Trace) -> Pixels:  # noqa: ARG002 - for those that keep memory
        return policy_picture(frame, self._wiring.options.payload, trace)

    def _failed(self, text: str, retry_after_s: float | None = None) -> RequestFailed:
        """Return the error that a server describes with ``text``."""
        reason = " ".join(struck(text).split())[-QUOTED:] or "an error without words"
        return RequestFailed(f"{self._url}: {reason}", retry_after_s=retry_after_s)

    def describe(self) -> dict[str, str]:
        """Return where the server is, and the template, for the manifest."""
        return {"url": self._url, "template": self._template.name}
