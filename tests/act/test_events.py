"""Inboxes: what was put is found in order, and waiting ends with the first event or at its time."""

from __future__ import annotations

from threading import Timer

import pytest

from s2a_bench.act.events import Event, LiveInbox, StreamEnded, TokenArrived, VirtualInbox
from s2a_bench.clock import VirtualClock, now_ns

FIRST, SECOND = TokenArrived(5), StreamEnded(5)


def test_a_live_inbox_waits_until_its_time_and_no_longer_than_for_an_event() -> None:
    inbox = LiveInbox()
    until_ns = now_ns() + 20_000_000
    assert inbox.wait(until_ns) == []
    assert now_ns() >= until_ns
    Timer(0.02, inbox.put, (FIRST,)).start()
    assert inbox.wait(now_ns() + 3600 * 10**9) == [FIRST]


@pytest.mark.parametrize(
    ("until_ns", "found", "at_ns"),
    [(4, [], 4), (5, [FIRST, SECOND], 5), (6, [FIRST, SECOND], 5), (None, [FIRST, SECOND], 5)],
)
def test_a_script_is_jumped_through(until_ns: int | None, found: list[Event], at_ns: int) -> None:
    clock = VirtualClock(0)
    inbox = VirtualInbox(clock, [TokenArrived(7), FIRST, SECOND])
    assert inbox.wait(until_ns) == found
    assert clock.now_ns() == at_ns


def test_an_event_of_the_past_is_given_now_and_an_empty_script_has_an_end() -> None:
    clock = VirtualClock(10)
    inbox = VirtualInbox(clock)
    inbox.put(FIRST)
    assert inbox.wait(None) == [FIRST]
    assert clock.now_ns() == 10
    assert inbox.wait(20) == []
    assert clock.now_ns() == 20
    with pytest.raises(RuntimeError, match="nothing will ever happen"):
        inbox.wait(None)
