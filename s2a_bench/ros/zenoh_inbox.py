"""What has arrived over Zenoh and waits to be taken: bounded, filled by Zenoh's threads, emptied by ours."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from itertools import islice
from threading import Condition
from typing import Final, Generic, TypeVar

from s2a_bench.clock import now_ns
from s2a_bench.ros.action_client import AT_ONCE
from s2a_bench.ros.waiting import WAIT_SLICE_NS

HELD_BYTES: Final = 256 << 20
"""What waits in one inbox may be so large; what comes then is dropped."""
EACH_BYTES: Final = 1024
"""What each item costs beside its bytes."""

Item = TypeVar("Item")
_log = logging.getLogger(__name__)


class Bell:
    """Wakes the thread that empties some inboxes."""

    def __init__(self) -> None:
        """Start silent."""
        self.condition = Condition()
        self.interrupted = False
        self._rung = False

    def ring(self) -> None:
        """Wake who waits; with the condition held."""
        self._rung = True
        self.condition.notify()

    def wait_until(self, deadline_ns: int) -> bool:
        """Return after an arrival, a time slice or an interrupt; False once the deadline or an interrupt has come."""
        with self.condition:
            left_ns = deadline_ns - now_ns()
            if left_ns <= 0 or self.interrupted:
                return False
            if not self._rung:
                self.condition.wait(min(left_ns, WAIT_SLICE_NS) / 1e9)
            self._rung = False
            return not self.interrupted

    def interrupt(self) -> None:
        """End a wait under way and every later one; callable from any thread."""
        with self.condition:
            self.interrupted = True
            self.condition.notify_all()


class Inbox(Generic[Item]):
    """What has come in for one endpoint: the last ``depth`` items, all for 0."""

    def __init__(self, name: str, bell: Bell, depth: int = 0, most_bytes: int = 0) -> None:
        """Start empty; it has room for `HELD_BYTES`, or as many as told."""
        self._name, self._bell, self._depth = name, bell, depth
        self._most = most_bytes or HELD_BYTES
        self._items: deque[tuple[Item, int]] = deque()
        self._bytes, self._told = 0, False

    def put(self, item: Item, size: int) -> bool:
        """Add an item and wake who waits; False if it found no room."""
        size += EACH_BYTES
        with self._bell.condition:
            if self._depth and len(self._items) >= self._depth:
                self._pop()
            if full := self._bytes + size > self._most:
                told, self._told = self._told, True
            else:
                self._items.append((item, size))
                self._bytes += size
            self._bell.ring()
        if full and not told:
            _log.warning("%s: messages are dropped: %d MiB wait to be taken", self._name, self._most >> 20)
        return not full

    def take(self) -> Item | None:
        """Return the oldest item, without waiting."""
        with self._bell.condition:
            return self._pop() if self._items else None

    def arrived(self) -> Iterator[Item]:
        """Take what has arrived, `AT_ONCE` items at most."""
        return islice(iter(self.take, None), AT_ONCE)

    def _pop(self) -> Item:
        item, size = self._items.popleft()
        self._bytes -= size
        return item
