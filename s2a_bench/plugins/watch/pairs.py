"""Pairs the answers on one topic with the observations on another; no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from s2a_bench.transport.tap import MOST_WAITING, Seen

STAMP, ORDER = "header stamp", "order"
UNDECIDED: Final = 10
"""Stamps of answers among which none is an observation's, so that order counts; the first may be of unseen ones."""


class TopicMessage(NamedTuple):
    answer: bool
    at_ns: int
    size: int
    stamp_ns: int | None = None
    """The stamp of its header; None for a type without one, and for a stamp that was not set."""


class Pairs:
    """Pairs observations with their answers; both are fed in order of time.

    They pair by stamp if one of the first `UNDECIDED` answers has that of an observation, else by order: then an answer
    belongs to the newest observation before it.
    Several answers to an observation are pieces of one; it is reported when another one is answered, and at the end.
    """

    def __init__(self, what: str, report: Callable[[Seen], None], *, stamped: bool) -> None:
        """``stamped``: whether the types of both have a header."""
        self.observations = self.answers = self.unpaired = 0
        self.paired = "" if stamped else ORDER
        self._what, self._report = what, report
        self._held = deque[TopicMessage](maxlen=MOST_WAITING)
        self._strange = set[int | None]()
        """Stamps of answers that no observation has."""
        self._waiting: dict[int, Seen] = {}
        self._newest = self._key = 0
        self._open: Seen | None = None

    def feed(self, message: TopicMessage) -> None:
        self.observations += not message.answer
        self.answers += message.answer
        if message.answer and not self.observations:
            self.unpaired += 1
        elif self.paired:
            self._pair(message)
        else:
            self._hold(message)

    def end(self) -> None:
        """Report the last exchange."""
        self._decide(self.paired or ORDER)
        self._close()

    def _hold(self, message: TopicMessage) -> None:
        """Keep a message until it is known what pairs them."""
        self._held.append(message)
        if message.answer:
            self._strange.add(message.stamp_ns)
        if message.answer and message.stamp_ns in {each.stamp_ns for each in self._held if not each.answer} - {None}:
            self._decide(STAMP)
        elif len(self._strange) >= UNDECIDED or (self._strange and len(self._held) == MOST_WAITING):
            self._decide(ORDER)

    def _decide(self, paired: str) -> None:
        self.paired = paired
        while self._held:
            self._pair(self._held.popleft())

    def _pair(self, message: TopicMessage) -> None:
        self._newest += not message.answer
        key = message.stamp_ns if self.paired == STAMP else self._newest
        if not message.answer:
            if key is not None:
                self._waiting[key] = Seen(self._what, message.at_ns, up_bytes=message.size)
                if len(self._waiting) > MOST_WAITING:
                    del self._waiting[next(iter(self._waiting))]
            return
        if key in self._waiting:
            self._close()
            self._key, self._open = key, self._waiting.pop(key)
        if self._open is None or key != self._key:
            self.unpaired += 1
            return
        self._open.answer_ns = self._open.answer_ns or message.at_ns
        self._open.end_ns = message.at_ns
        self._open.down_bytes += message.size
        self._open.pieces_ns.append(message.at_ns)

    def _close(self) -> None:
        if seen := self._open:
            self._open = None
            if seen.pieces_ns == [seen.answer_ns]:  # an answer in one message is not a stream
                seen.pieces_ns.clear()
            self._report(seen)
