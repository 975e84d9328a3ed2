"""Executors in virtual time: plans as scripts of events, and robots that obey commands, or not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from s2a_bench.act import Report, Running, SkillRobot
from s2a_bench.act.events import Event, Requested, SkillArrived, SkillOver, StreamEnded, TokenArrived, VirtualInbox
from s2a_bench.act.executor import Executor
from s2a_bench.act.record import Record
from s2a_bench.clock import VirtualClock
from s2a_bench.plan import Call, Gap, Skill
from s2a_bench.policy import POLICIES, PlanShape, Policy, Timing, policy

ZERO_NS = 7_000_000_000
"""When the request is made: not at 0, so that nobody mistakes one for the other."""

EVERY_POLICY = tuple(POLICIES)


def ns(seconds: float) -> int:
    return ZERO_NS + round(seconds * 1e9)


def call(name: str = "go", nominal_s: float = 1.0, least: float = 0.8, most: float = 1.5, gap: Gap = "hold") -> Call:
    return Call(Skill(name, (), Timing(nominal_s, least * nominal_s, most * nominal_s), gap), ())


def script(token_s: Sequence[float], arrivals: Sequence[tuple[float, Call]], end_s: float | None = None) -> list[Event]:
    """A stream that ends with its last event, or at ``end_s`` (never: a negative time)."""
    events: list[Event] = [Requested(ns(0))]
    events += sorted(
        [*(TokenArrived(ns(at)) for at in token_s), *(SkillArrived(ns(at), skill) for at, skill in arrivals)],
        key=lambda event: (event.at_ns, isinstance(event, SkillArrived)),
    )
    last_s = max([*token_s, *(at for at, _ in arrivals)], default=0.0) if end_s is None else end_s
    return [*events, StreamEnded(ns(last_s))] if last_s >= 0 else events


def plan(arrival_s: Sequence[float], names: Sequence[str] = ()) -> list[Event]:
    """Skills of one second, one token each; the stream ends with the last."""
    calls = [call(names[place] if names else f"skill{place}") for place in range(len(arrival_s))]
    return script(arrival_s, list(zip(arrival_s, calls, strict=True)))


@dataclass
class Obedient:
    """Obeys time, and records its commands."""

    clock: VirtualClock
    commands: list[tuple[float, str]] = field(default_factory=list)
    closed: bool = False

    def say(self, what: str) -> None:
        self.commands.append((round((self.clock.now_ns() - ZERO_NS) / 1e9, 6), what))

    def start(self, call: Call, end_ns: int, report: Report) -> Running:
        self.say(f"start {call.skill.name} until {(end_ns - ZERO_NS) / 1e9:g}")
        return self.running(end_ns, report)

    def running(self, end_ns: int, report: Report) -> Running:  # noqa: ARG002 - others need them
        return Task(self)

    def hold(self, gap: Gap) -> None:
        self.say(gap)

    def close(self) -> None:
        self.closed = True


@dataclass
class Task:
    robot: Obedient
    obeys: bool = True

    def retime(self, end_ns: int) -> None:
        self.robot.say(f"until {(end_ns - ZERO_NS) / 1e9:g}")

    def ended(self) -> bool:
        return self.obeys

    def abort(self) -> None:
        self.robot.say("abort")


@dataclass
class SelfPaced(Obedient):
    """Takes each skill ``off_s`` longer (or shorter) than commanded, and reports its end itself; inf: never."""

    off_s: float = 0.0
    error: str = ""
    inbox: VirtualInbox | None = None
    count: int = 0

    def running(self, end_ns: int, report: Report) -> Running:  # noqa: ARG002 - in virtual time the end is foreseen
        if self.off_s != float("inf"):
            assert self.inbox is not None
            self.inbox.put(SkillOver(end_ns + round(self.off_s * 1e9), self.count, self.error))
        self.count += 1
        return Task(self, obeys=False)


def shape(n_skills: int, tokens: float = 1, **more: float) -> PlanShape:
    return PlanShape(n_skills, tokens, Timing(1.0, 0.8, 1.5), **more)


def run(
    events: Sequence[Event],
    n_skills: int,
    *,
    by: str | Policy = "naive",
    robot: Callable[[VirtualClock], Obedient] = Obedient,
    known: PlanShape | None = None,
    silence_s: float = 60.0,
) -> tuple[Record, Obedient]:
    """Run one plan and return the record and the robot."""
    clock = VirtualClock(ZERO_NS - 1_000_000_000)
    inbox = VirtualInbox(clock, events)
    body = robot(clock)
    if isinstance(body, SelfPaced):
        body.inbox = inbox
    rule = policy(by) if isinstance(by, str) else by
    checked: SkillRobot = body
    executor = Executor(
        rule, known or shape(n_skills), checked, inbox, clock, gap="cruise", silence_s=silence_s, patience_s=5.0
    )
    return executor.run(), body


def starts(record: Record) -> list[float]:
    assert record.requested_ns == ZERO_NS
    return [round((skill.start_ns - ZERO_NS) / 1e9, 6) for skill in record.skills]


def ends(record: Record) -> list[float | None]:
    return [skill.end_ns and round((skill.end_ns - ZERO_NS) / 1e9, 6) for skill in record.skills]
