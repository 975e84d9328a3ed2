"""The closed loop: the world steps while the model writes, and the ego is the robot of an `Executor`.

One thread runs both: a step of the world is due while the executor waits for events, so that neither needs a lock. At
the same instant the executor acts first, as a roll-out decides before it steps. The clock may be virtual. Steps are due
at fixed intervals; a world that is late catches up, but at most `SLACK_S`: beyond, it runs slower than the clock, and
``real_time_factor`` falls below 1. Before the request all cars keep their speed; the lead brakes from the request on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from s2a_bench.act import Report
from s2a_bench.act.events import (
    AbortRequested,
    Event,
    EventQueue,
    Requested,
    SkillArrived,
    StreamEnded,
    TokenArrived,
    VirtualInbox,
)
from s2a_bench.act.executor import NEVER, Executor
from s2a_bench.act.record import Record
from s2a_bench.clock import Clock, VirtualClock
from s2a_bench.frames import FrameSource
from s2a_bench.plan import Call, Gap
from s2a_bench.policy import Plans, PlanShape, Policy, Schedule
from s2a_bench.policy.schedule import safe_start
from s2a_bench.scenario import Simulator
from s2a_bench.scenario.ccrb.drive import AFTER_S, Drive, Driven
from s2a_bench.scenario.ccrb.ego import ACTING, Ego
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.types import Frame

SLACK_S: Final = 0.1
PICTURE_NS: Final = 200_000_000


class CommandedEgo(Ego):
    """The ego as a robot: each skill that starts leads evenly to the plan's next set-point, whatever its call says.

    A skill that is extended keeps the speed that it has reached; unlike a roll-out, nothing knows of that beforehand.
    """

    def __init__(self, scenario: CcrbOptions, now_s: Callable[[], float], since_s: Callable[[int], float]) -> None:
        shape = (scenario.skills, 1)
        super().__init__(scenario.cars, scenario.driving, Schedule(np.full(shape, np.inf), np.zeros(shape)), 1)
        self._start_s, self._duration_s = np.full(shape, np.inf), np.zeros(shape)
        self._now_s, self._since_s = now_s, since_s

    def start(self, call: Call, end_ns: int, report: Report) -> CommandedEgo:  # noqa: ARG002 - the ego obeys time
        now_s, index = self._now_s(), int(self.index[0]) + 1
        self._start_s[index], self._duration_s[index] = now_s, self._since_s(end_ns) - now_s
        self._next_s = self._start_s[index].copy()
        self._advance(now_s)
        return self

    def retime(self, end_ns: int) -> None:
        now_s, end_s = self._now_s(), self._since_s(end_ns)
        self._level = self._level + self._slope * (np.minimum(now_s, self._until_s) - self._from_s)
        self._slope = (self._points[self.index[0] + 1] - self._level) / max(end_s - now_s, 1e-9)
        self._from_s, self._until_s = np.array([now_s]), np.array([end_s])

    def hold(self, gap: Gap) -> None:
        """Do nothing: the scenario's gap behaviour follows a skill's end."""

    def ended(self) -> bool:
        return True

    def abort(self) -> None:
        self._until_s = np.array([self._now_s()])

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Looped:
    """A plan that was executed in a closed loop."""

    record: Record
    driven: Driven
    real_time_factor: float
    tracking_rms_mps: float | None
    """None if no skill ran before an impact."""


class ClosedLoop:
    """One policy's run: the inbox of its executor, whose wait steps the world. Use it once."""

    def __init__(
        self, scenario: CcrbOptions, world: Simulator, inbox: EventQueue, clock: Clock, view: FrameSource | None = None
    ) -> None:
        """Place the cars; ``inbox`` delivers events on ``clock``, and ``view`` of the world `pictures` to be kept."""
        self._inbox, self._clock = inbox, clock
        self._calls = iter(scenario.calls)
        self._zero_ns: int | None = None
        self._ego = CommandedEgo(scenario, lambda: self._since_s(clock.now_ns()), self._since_s)
        self._drive = Drive(world, scenario.cars, self._ego, record=True)
        self._step_ns = round(world.step_s * 1e9)
        self._first_ns = self._due_ns = self._last_ns = self._picture_ns = clock.now_ns()
        self._steps = 0
        self._squares: list[float] = []
        self._view, self.pictures = view, list[Frame]()

    def put(self, event: Event) -> None:
        """Deliver an event, a skill as the scenario's of that number."""
        if isinstance(event, SkillArrived):
            event = SkillArrived(event.at_ns, next(self._calls, event.call))
        self._inbox.put(event)

    def wait(self, until_ns: int | None) -> list[Event]:
        limit_ns = NEVER if until_ns is None else until_ns
        while True:
            wake_ns = min(limit_ns, self._due_ns)
            events = self._inbox.wait(None if wake_ns == NEVER else wake_ns)
            for event in events:
                if isinstance(event, Requested):
                    self._zero_ns = event.at_ns
                elif _is_abort(event):
                    self._due_ns = NEVER
            if events or limit_ns <= self._due_ns:
                return events
            self._step()

    def run(self, policy: Policy, shape: PlanShape, silence_s: float) -> Looped:
        """Execute a plan, and step on until the outcome is certain; raises what the world raises.

        Once the ego rests after its plan nothing depends on the clock: the car behind closes up without waiting.
        """
        record = Executor(policy, shape, self._ego, self, self._clock, silence_s=silence_s).run()
        until_ns = self._clock.now_ns() + round(AFTER_S * 1e9)
        while record.outcome == "completed" and self._due_ns < until_ns:
            if self._drive.ego_moves and any(map(_is_abort, self._inbox.wait(self._due_ns))):
                break
            if not self._drive.ego_moves or self._clock.now_ns() >= self._due_ns:
                self._step()
        driven = Driven(self._drive.outcomes(), self._drive.trajectory())
        tracking_mps = float(np.sqrt(np.mean(self._squares))) if self._squares else None
        return Looped(record, driven, self.real_time_factor, tracking_mps)

    @property
    def real_time_factor(self) -> float:
        """Simulated over elapsed time."""
        return self._steps * self._step_ns / max(self._last_ns - self._first_ns, 1)

    def _step(self) -> None:
        now_ns = self._due_ns
        self._drive.step(self._since_s(now_ns))
        self._squares += (self._ego.lag_mps[self._ego.phase == ACTING] ** 2).tolist()
        self._steps += 1
        self._last_ns = now_ns + self._step_ns
        if self._view and self._drive.ego_moves and self._clock.now_ns() >= self._picture_ns:
            self._picture_ns = self._clock.now_ns() + PICTURE_NS
            self.pictures.append(self._view.read())
        slack_ns = round(SLACK_S * 1e9)
        self._due_ns = NEVER if self._drive.decided().all() else max(self._last_ns, self._clock.now_ns() - slack_ns)

    def _since_s(self, at_ns: int) -> float:
        """Return the time since the request; negative before it."""
        return -1.0 if self._zero_ns is None else (at_ns - self._zero_ns) / 1e9


def _is_abort(event: Event) -> bool:
    return isinstance(event, AbortRequested)


def replayed(scenario: CcrbOptions, world: Simulator, policy: Policy, plans: Plans) -> Looped:
    """Run a loop in virtual time on the arrivals of one plan, with tokens and shape."""
    assert plans.token_s is not None and plans.shape is not None  # noqa: S101, PT018 - drawn and observed plans have both
    clock = VirtualClock()
    loop = ClosedLoop(scenario, world, VirtualInbox(clock), clock)
    token_ns, skill_ns = (
        np.rint(times_s[:, 0] * 1e9).astype(int).tolist() for times_s in (plans.token_s, plans.arrival_s)
    )
    loop.put(Requested(0))
    for at_ns in token_ns:
        loop.put(TokenArrived(at_ns))
    for at_ns, call in zip(skill_ns, scenario.calls, strict=True):
        loop.put(SkillArrived(at_ns, call))
    loop.put(StreamEnded(token_ns[-1]))
    safe_s = float(safe_start(plans.arrival_s, plans.nominal_s)[0])
    longest_s = token_ns[-1] / 1e9 + 1  # no board is taken for silent
    return loop.run(policy, replace(plans.shape, safe_start_s=safe_s), longest_s)
