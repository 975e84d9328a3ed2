"""From tokens to events: one parser reads the stream, and every executor that follows it is told the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from s2a_bench.plan import Event as PlanEvent
from s2a_bench.plan import Parser, SkillParsed
from s2a_bench.runtime.events import Event, Fault, Requested, SkillCame, StreamBroke, StreamEnded, TokenCame


class PlanFeed:
    """Told what a stream brings, by the thread that reads it."""

    def __init__(self, parser: Parser, tell: Callable[[Event], None]) -> None:
        """Read with ``parser``, a new one for every answer; ``tell`` delivers to whoever follows, as `Inbox.put`."""
        self._parser = parser
        self._tell = tell
        self.token_ns: list[int] = []
        """When each token arrived."""
        self.requested_ns: int | None = None

    def requested(self, at_ns: int) -> None:
        """Say that the plan has been asked for."""
        self.requested_ns = at_ns
        self._tell(Requested(at_ns))

    def token(self, text: str | bytes, at_ns: int) -> None:
        """Take a token that arrived at ``at_ns``: the skills that it completes arrived then too."""
        self.token_ns.append(at_ns)
        self._tell(TokenCame(at_ns))
        self._parsed(self._parser.feed(text), at_ns)

    def ended(self, at_ns: int) -> None:
        """Say that the stream has ended as it should."""
        self._parsed(self._parser.close(), at_ns)
        self._tell(StreamEnded(at_ns))

    def broke(self, why: str, at_ns: int, fault: Fault = "stream-error") -> None:
        """Say that the stream has died."""
        self._tell(StreamBroke(at_ns, fault, why))

    def _parsed(self, events: Sequence[PlanEvent], at_ns: int) -> None:
        for event in events:
            if isinstance(event, SkillParsed):
                self._tell(SkillCame(at_ns, event.call))
            else:
                self.broke(f"line {event.line + 1} ({event.problem}): {event.why}", at_ns, "invalid-line")
