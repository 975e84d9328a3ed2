"""The executor in virtual time: it does what the policy says, and nothing when it should not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.act.events import (
    AbortRequested,
    Event,
    Requested,
    SkillArrived,
    StreamBroke,
    StreamEnded,
    TokenArrived,
    VirtualInbox,
)
from s2a_bench.act.executor import Executor
from s2a_bench.act.record import Record, observed
from s2a_bench.act.timed import TimedRobot
from s2a_bench.clock import VirtualClock
from s2a_bench.policy import Plans, PlanShape, Start, Stepper, policy
from s2a_bench.policy.nominal import Naive, NominalQueue
from s2a_bench.policy.schedule import safe_start
from s2a_bench.testing.policy import one, seeded
from tests.act.drive import (
    EVERY_POLICY,
    ZERO_NS,
    Obedient,
    SelfPaced,
    call,
    ends,
    ns,
    plan,
    run,
    script,
    shape,
    starts,
)

NS = 1e-6
"""Times are whole nanoseconds, and policies multiply them."""


class Elastic:
    """Naive, except that skills may be held on to half as long again."""

    name = "naive"
    schedule = Naive().schedule

    def stepper(self, shape: PlanShape) -> Stepper:
        del shape
        return ElasticQueue()


class ElasticQueue(NominalQueue):
    def decide(self, now_s: float) -> Start | float:
        answer = super().decide(now_s)
        return replace(answer, latest_s=1.5 * answer.duration_s) if isinstance(answer, Start) else answer


def follow(plans: Plans, name: str) -> Record:
    """Execute one plan of shape (N, 1)."""
    assert plans.token_s is not None
    assert plans.shape is not None
    arrays = (plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s)
    columns = zip(*(array[:, 0].tolist() for array in arrays), strict=True)
    arrivals = [
        (at, call(f"skill{place}", nominal, least / nominal, most / nominal))
        for place, (at, nominal, least, most) in enumerate(columns)
    ]
    first_s = float(safe_start(plans.arrival_s, plans.nominal_s)[0])
    known = replace(plans.shape, safe_start_s=first_s)
    return run(script(plans.token_s[:, 0].tolist(), arrivals), plans.shape.n_skills, by=name, known=known)[0]


@pytest.mark.parametrize("name", EVERY_POLICY)
@given(plans=seeded)
def test_what_is_executed_is_what_the_policy_schedules(name: str, plans: Plans) -> None:
    plan_ = one(plans, 0)
    record = follow(plan_, name)
    schedule = policy(name).schedule(plan_)
    assert record.outcome == "completed"
    assert record.why == ""
    start_s = [(skill.start_ns - ZERO_NS) / 1e9 for skill in record.skills]
    duration_s = [((skill.end_ns or 0) - skill.start_ns) / 1e9 for skill in record.skills]
    assert start_s == pytest.approx(schedule.start_s[:, 0].tolist(), abs=NS)
    assert duration_s == pytest.approx(schedule.duration_s[:, 0].tolist(), abs=NS)
    assert [skill.jitter_ns for skill in record.skills] == [0] * len(start_s)


@given(plans=seeded, name=st.sampled_from(EVERY_POLICY), dies=st.data(), how=st.sampled_from(["broke", "silent"]))
def test_a_stream_that_dies_anywhere_leaves_the_robot_holding(
    plans: Plans, name: str, dies: st.DataObject, how: str
) -> None:
    plan_ = one(plans, 0)
    assert plan_.token_s is not None
    assert plan_.shape is not None
    calls = [call(f"skill{place}") for place in range(len(plan_.arrival_s))]
    arrivals = list(zip(plan_.arrival_s[:, 0].tolist(), calls, strict=True))
    events = script(plan_.token_s[:, 0].tolist(), arrivals)[:-1]
    cut = dies.draw(st.integers(1, len(events)))
    kept = events[:cut]
    death_ns = kept[-1].at_ns + 1
    whole = sum(isinstance(event, SkillArrived) for event in kept) == len(calls)
    ending = [StreamBroke(death_ns, "stream-error", "cut")] if how == "broke" else []
    known = replace(plan_.shape, safe_start_s=float(safe_start(plan_.arrival_s, plan_.nominal_s)[0]))
    record, robot = run([*kept, *ending], len(calls), by=name, known=known, silence_s=100.0)
    if whole and how == "broke":
        assert record.outcome == "completed"
    elif not whole:
        assert record.outcome == ("stream-error" if how == "broke" else "silence")
        silence_ns = 0 if how == "broke" else 100 * 10**9
        assert all(skill.start_ns <= death_ns + silence_ns for skill in record.skills)
    came = [skill for event in kept if isinstance(event, SkillArrived) for skill in [event.call.skill.name]]
    assert [skill.call.skill.name for skill in record.skills] == came[: len(record.skills)]
    assert all(skill.end_ns is not None for skill in record.skills)
    assert robot.commands[-1][1] == ("hold" if record.skills else "cruise")


def test_unless_told_otherwise_silence_is_a_minute_and_a_skill_may_overrun_by_ten_seconds() -> None:
    for events, why in (
        ([Requested(ns(0))], "no token for 60 s"),
        (plan([1.0]), "skill0() went on for 10 s after its end"),
    ):
        clock = VirtualClock(ns(0))
        inbox = VirtualInbox(clock, events)
        record = Executor(Naive(), shape(1), SelfPaced(clock, off_s=float("inf")), inbox, clock).run()
        assert record.why == why


def test_silence_counts_from_the_last_token() -> None:
    record, robot = run([Requested(ns(0)), TokenArrived(ns(4))], 3, silence_s=10.0)
    assert (record.outcome, record.why, record.skills) == ("silence", "no token for 10 s", [])
    assert record.ended_ns == ns(14)
    assert robot.commands == [(-1.0, "cruise")]


BROKE = StreamBroke(ns(1.2), "invalid-line", "Enjoy!")


@pytest.mark.parametrize(
    ("events", "options", "starts_s", "ends_s"),
    [
        (plan([1.0, 1.5])[:-1], {"silence_s": 1.1}, [1.0, 2.0], [2.0, 3.0]),
        ([*plan([1.0, 1.1])[:-1], BROKE], {}, [1.0, 2.0], [2.0, 3.0]),
        (plan([1.0, 1.1]), {"robot": partial(SelfPaced, off_s=-0.25)}, [1.0, 1.75], [1.75, 2.5]),
        (plan([1.0, 1.1]), {"robot": partial(SelfPaced, off_s=0.5)}, [1.0, 2.5], [2.5, 4.0]),
        (script([1.0, 4.0], [(1.0, call("a")), (4.0, call("b"))]), {"by": Elastic()}, [1.0, 4.0], [2.5, 5.0]),
    ],
    ids=["silence after the last skill", "prose after the plan", "done early", "overrun", "extended to its bound"],
)
def test_a_plan_is_completed_with_each_skill_after_the_one_before(
    events: list[Event], options: dict[str, Any], starts_s: list[float], ends_s: list[float]
) -> None:
    record, _ = run(events, 2, **options)
    assert (record.outcome, starts(record), ends(record)) == ("completed", starts_s, ends_s)


def test_a_bad_line_ends_the_plan_where_it_stands() -> None:
    first, second = call("first"), call("second")
    events = [Requested(ns(0)), SkillArrived(ns(1), first), BROKE]
    record, _ = run([*events, SkillArrived(ns(1.3), second), StreamEnded(ns(2))], 2)
    assert (record.outcome, len(record.arrivals)) == ("invalid-line", 1)
    assert [skill.call for skill in record.skills] == [first]


@pytest.mark.parametrize("name", [name for name in EVERY_POLICY if name != "s2a-clairvoyant"])
def test_a_stream_that_ends_early_is_carried_out_and_said_to_be_short(name: str) -> None:
    record, _ = run(plan([1.0, 2.0, 3.0]), 5, by=name)
    assert (record.outcome, record.why) == ("short", "3 of 5 skills arrived")
    assert len(record.ran) == 3


@pytest.mark.parametrize("name", EVERY_POLICY)
def test_more_skills_than_announced_are_counted_and_not_carried_out(name: str) -> None:
    record, _ = run(plan([1.0, 1.1, 1.2, 1.3]), 2, by=name, known=shape(2, safe_start_s=1.0))
    assert (record.outcome, len(record.skills), record.extra) == ("completed", 2, 2)


def test_a_missing_skill_is_a_stall_that_is_counted_as_it_happened() -> None:
    record, robot = run(plan([1.0, 4.0]), 2)
    assert record.stalls_ns == [2_000_000_000]
    assert [(command.what, command.index) for command in record.commands] == [
        *(("hold", -1), ("start", 0), ("end", 0), ("hold", 0), ("start", 1), ("end", 1), ("hold", 1)),
    ]
    assert robot.commands[1:4] == [(1.0, "start skill0 until 2"), (2.0, "hold"), (4.0, "start skill1 until 5")]


def test_a_skill_is_extended_while_the_next_is_missing_and_compressed_when_it_comes() -> None:
    record, robot = run(script([0.9, 1.0, 2.2], [(1.0, call("a")), (2.2, call("b"))]), 2, by=Elastic())
    words = ["start a until 2", "until 2.5", "until 2.2", "start b until 3.2"]
    assert robot.commands[1:5] == list(zip([1.0, 2.0, 2.2, 2.2], words, strict=True))
    assert [command.what for command in record.commands][1:5] == ["start", "extend", "compress", "end"]
    assert (record.stalls_ns, ends(record)) == ([0], [2.2, 3.2])
    assert [(skill.duration_ns, skill.latest_ns) for skill in record.skills] == [(10**9, 3 * 10**9 // 2)] * 2


def test_a_skill_that_never_ends_is_aborted_when_the_patience_is_over() -> None:
    record, robot = run(plan([1.0, 1.1]), 2, robot=partial(SelfPaced, off_s=float("inf")))
    assert (record.outcome, record.why) == ("skill-overran", "skill0() went on for 5 s after its end")
    assert ends(record) == [7.0]
    assert [word for _, word in robot.commands[-2:]] == ["abort", "hold"]


def test_a_skill_that_fails_ends_the_plan() -> None:
    record, robot = run(plan([1.0, 1.1]), 2, robot=partial(SelfPaced, off_s=-0.5, error="dropped the cup"))
    assert (record.outcome, record.why) == ("skill-failed", "skill0(): dropped the cup")
    assert (len(record.skills), robot.commands[-1]) == (1, (1.5, "hold"))


def test_a_robot_whose_call_raises_ends_the_plan_and_not_the_executor() -> None:
    class Broken(Obedient):
        def start(self, *_: object) -> None:  # type: ignore[override]
            raise OSError("no arm")

    record, robot = run(plan([1.0, 1.1]), 2, robot=Broken)
    assert (record.outcome, record.why, record.skills) == ("skill-failed", "the robot: OSError: no arm", [])
    assert [word for _, word in robot.commands] == ["cruise"]


@pytest.mark.parametrize("at_s", [0.5, 1.0, 1.5, 2.5])
def test_an_abort_ends_everything_at_once(at_s: float) -> None:
    record, robot = run([*plan([1.0, 4.0])[:-1], AbortRequested(ns(at_s)), StreamEnded(ns(4))], 2)
    assert (record.outcome, record.why) == ("aborted", "abort requested")
    assert len(record.skills) == (at_s > 1)
    assert ends(record) == [min(at_s, 2.0)] * (at_s > 1)
    assert ((at_s, "abort") in robot.commands) == (at_s == 1.5)
    assert robot.commands[-1][1] in {"hold", "cruise"}


def test_an_abort_before_the_request_ends_it_too() -> None:
    record, _ = run([AbortRequested(ns(-0.5))], 2)
    assert (record.outcome, record.requested_ns) == ("aborted", None)


def test_the_gap_of_the_skill_that_ran_last_fills_the_stall() -> None:
    events = script([1, 4], [(1.0, call("a", gap="coast")), (4.0, call("b", gap="stop"))])
    _, robot = run(events, 2)
    assert [word for _, word in robot.commands if " " not in word] == ["cruise", "coast", "stop"]


class LateInbox:
    """Hands everything over at once, when a thread that was kept from running looks at last."""

    def __init__(self, clock: VirtualClock, events: list[Event], seen_ns: int) -> None:
        self._clock, self._events, self._seen_ns = clock, events, seen_ns

    def put(self, event: Event) -> None:
        self._events.append(event)

    def wait(self, until_ns: int | None) -> list[Event]:
        found, self._events = self._events, []
        self._clock.sleep_until_ns(self._seen_ns if found else until_ns or 0)
        return found


def test_being_late_for_several_events_is_jitter_since_the_first() -> None:
    clock = VirtualClock()
    came_ns = 10_000_000
    skill = SkillArrived(came_ns, call("wave", 1.0, 1.0, 1.0))
    events: list[Event] = [Requested(came_ns), TokenArrived(came_ns), skill, TokenArrived(came_ns + 8_000_000)]
    inbox = LateInbox(clock, events, came_ns + 9_000_000)
    record = Executor(Naive(), shape(1), TimedRobot(), inbox, clock).run()
    assert [run.jitter_ns for run in record.skills] == [9_000_000]


SKILLS = [(1.5, call("a", 2.0)), (3.0, call("b", 1.0)), (3.5, call("c"))]


def test_a_plan_that_came_is_seen_in_seconds_from_its_request() -> None:
    record, _ = run(script([1.0, 1.5, 2.0, 3.0, 3.5], SKILLS), 2)
    plans = observed(record, shape(2))
    assert plans is not None
    assert plans.arrival_s.tolist() == [[1.5], [3.0]]
    assert plans.nominal_s.tolist() == [[2.0], [1.0]]
    assert plans.least_s.tolist() == [[1.6], [0.8]]
    assert plans.most_s.tolist() == [[3.0], [1.5]]
    assert plans.token_s is not None
    assert plans.token_s.tolist() == [[1.0], [1.5], [2.0], [3.0], [3.5]]
    assert plans.shape == shape(2)


@pytest.mark.parametrize("lack", [{"requested_ns": None}, {"token_ns": []}, {"arrivals": [(ns(1), call("a"))]}])
def test_a_plan_that_did_not_come_whole_is_not_seen(lack: dict[str, object]) -> None:
    record, _ = run(script([1.0, 1.5, 3.0], SKILLS[:2]), 2)
    assert observed(record, shape(2)) is not None
    assert observed(replace(record, **lack), shape(2)) is None  # type: ignore[arg-type]
