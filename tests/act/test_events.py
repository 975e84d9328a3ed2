"""Inboxes find what was put in order; from text to executors, any chunking gives the same plan."""

from __future__ import annotations

from threading import Timer

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.act.events import Event, LiveInbox, PlanFeed, StreamEnded, TokenArrived, VirtualInbox
from s2a_bench.act.executor import Executor
from s2a_bench.act.record import Record
from s2a_bench.clock import VirtualClock, now_ns
from s2a_bench.plan import Parser, load_skills, paper_format
from s2a_bench.policy import policy
from tests.act.drive import Obedient, ns, shape, starts

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


HOUSEHOLD = load_skills("household")
PLAN = "1. go_to(kitchen)\n2. pick(cup)\n3. place(cup, table)\n"


def execute(chunks: list[str], n_skills: int, gap_s: float = 0.5, name: str = "naive", broke: str = "") -> Record:
    events: list[Event] = []
    feed = PlanFeed(Parser(paper_format(HOUSEHOLD)), events.append)
    feed.requested(ns(0))
    for place, chunk in enumerate(chunks, start=1):
        feed.token(chunk, ns(place * gap_s))
    if broke:
        feed.broke(broke, ns((len(chunks) + 1) * gap_s))
    else:
        feed.ended(ns((len(chunks) + 1) * gap_s))
    clock = VirtualClock(ns(0))
    robot = Obedient(clock)
    record = Executor(policy(name), shape(n_skills), robot, VirtualInbox(clock, events), clock).run()
    assert {word.split()[1] for _, word in robot.commands if word.startswith("start")} <= {"go_to", "pick", "place"}
    return record


def test_a_skill_arrives_with_the_token_that_completes_it() -> None:
    record = execute(["1. go_to(", "kitchen", ")\n2. pick(cup)\n", "3. place(cup, table)"], 3)
    assert [(at_ns - ns(0)) / 1e9 for at_ns, _ in record.arrivals] == [1.5, 1.5, 2.5]
    assert starts(record) == [1.5, 5.5, 7.5]


def test_skills_before_a_malformed_line_are_begun_and_those_after_it_are_not() -> None:
    record = execute(["1. go_to(kitchen)\n", "2. fly(roof)\n", "3. pick(cup)\n"], 3)
    assert record.outcome == "invalid-line"
    assert record.why == "line 2 (unknown-skill): 'fly' is not one of the skills"
    assert [str(skill.call) for skill in record.skills] == ["go_to(kitchen)"]


@given(length=st.integers(0, len(PLAN)), name=st.sampled_from(["naive", "wait-then-act", "stream-to-act"]))
def test_an_answer_cut_off_anywhere_starts_nothing_that_was_not_written(length: int, name: str) -> None:
    record = execute(list(PLAN[:length]), 3, gap_s=0.05, name=name, broke="the server died")
    written = PLAN[:length].count("\n")
    assert record.outcome == ("completed" if written == 3 else "stream-error")
    assert [str(skill.call) for skill in record.skills] == [
        str(call) for _, call in record.arrivals[: len(record.skills)]
    ]
    assert len(record.arrivals) == written
