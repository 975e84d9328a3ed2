"""The executor: one policy's stepper on one live stream, with a robot that executes its decisions, all recorded.

Rules of this file:
- Between two events it sleeps until the next decision or deadline; it never polls.
- Only skills that the parser has emitted are started, in their order, one at a time, at most as many as announced.
- A skill ends when it reports its end, or at its commanded end if it obeys time. At its nominal end with the next skill
  missing it is *extended* up to the policy's ``latest_s``; when the next arrives meanwhile it is *compressed* to now.
- After a skill that ends before its commanded end the next starts at once: waiting would only move idle time (T1).
- While no skill runs the robot *holds* with the gap behaviour of the last skill, that of the set before the first.
- If the stream breaks (error, silence, an invalid line) before all announced skills have arrived, the running skill
  ends, no other is started, and the robot holds. After the last announced skill the stream is ignored.
- A skill that fails or overruns its end by more than the patience ends the plan the same way; abort ends it at once.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Final, TypeVar

from s2a_bench.act import Running, SkillRobot, events
from s2a_bench.act.record import Outcome, Record, RobotCommand, SkillRun, What
from s2a_bench.clock import Clock
from s2a_bench.plan import Gap
from s2a_bench.policy import PlanShape, Policy, Start

SILENCE_S: Final = 60.0
"""Longest time without a token before the stream counts as broken."""
PATIENCE_S: Final = 10.0
"""Longest time that a skill may run on after its commanded end."""
NEVER: Final = sys.maxsize
"""A wake time after all others: the executor waits for an event."""

_T = TypeVar("_T")


class Executor:
    """Executes one plan. `run` blocks; other threads may read ``record`` meanwhile."""

    def __init__(
        self,
        policy: Policy,
        shape: PlanShape,
        robot: SkillRobot,
        inbox: events.EventQueue,
        clock: Clock,
        *,
        gap: Gap = "hold",
        silence_s: float = SILENCE_S,
        patience_s: float = PATIENCE_S,
        name: str = "",
    ) -> None:
        """Follow the stream in ``inbox``; ``gap`` fills the time before the first skill; ``name`` is the record's."""
        self.record = Record(name or policy.name)
        self._stepper = policy.stepper(shape)
        self._announced = shape.n_skills
        self._robot, self._inbox, self._clock = robot, inbox, clock
        self._gap = gap
        self._silence_ns, self._patience_ns = round(silence_s * 1e9), round(patience_s * 1e9)
        self._running: Running | None = None
        self._open = True
        self._holding = False
        self._failure: tuple[Outcome, str] | None = None
        self._last_token_ns = 0
        self._policy_s = 0.0

    def run(self) -> Record:
        """Follow the plan to its end and return the record; errors of stream and robot are outcomes, not exceptions."""
        due_ns = self._clock.now_ns()
        while (wake_ns := self._act(due_ns)) is not None:
            received = self._inbox.wait(None if wake_ns == NEVER else wake_ns)
            for event in received:
                self._receive(event)
            # Of several events the first: they queued because this thread was late, which is jitter too.
            due_ns = min([wake_ns, *(event.at_ns for event in received)])
        return self.record

    def _receive(self, event: events.Event) -> None:
        record = self.record
        match event:
            case events.Requested(at_ns):
                record.requested_ns = self._last_token_ns = at_ns
            case events.TokenArrived(at_ns) if self._open:
                record.token_ns.append(at_ns)
                self._last_token_ns = at_ns
                self._stepper.token(self._policy_time_s(at_ns))
            case events.SkillArrived(at_ns, call) if self._open and not self._whole:
                record.arrivals.append((at_ns, call))
                self._stepper.fragment(self._policy_time_s(at_ns), call.skill.durations)
            case events.SkillArrived() if self._open:
                record.extra += 1
            case events.StreamEnded(at_ns):
                self._close(at_ns)
            case events.StreamBroke(at_ns, fault, why):
                self._break(at_ns, fault, why)
            case events.SkillOver(at_ns, index, error):
                self._over(at_ns, index, error)
            case events.AbortRequested(at_ns, why):
                self._failure = ("aborted", why)
                self._close(at_ns)

    @property
    def _whole(self) -> bool:
        return len(self.record.arrivals) >= self._announced

    def _policy_time_s(self, at_ns: int) -> float:
        self._policy_s = max((at_ns - (self.record.requested_ns or 0)) / 1e9, self._policy_s)
        return self._policy_s

    def _close(self, at_ns: int) -> None:
        if self._open:
            self._open = False
            self.record.ended_ns = at_ns
            self._stepper.end(self._policy_time_s(at_ns))

    def _break(self, at_ns: int, fault: events.Fault, why: str) -> None:
        if self._open and not self._whole:
            self._fail(fault, why)
        self._close(at_ns)

    def _fail(self, outcome: Outcome, why: str) -> None:
        self._failure = self._failure or (outcome, why)

    def _over(self, at_ns: int, index: int, error: str) -> None:
        """End the skill that reports its end; a late report of an aborted one is ignored."""
        if self._running is None or index != len(self.record.skills) - 1:
            return
        self._end(at_ns)
        if error:
            self._fail("skill-failed", f"{self.record.skills[index].call}: {error}")

    def _act(self, due_ns: int) -> int | None:
        """Act on everything that is due since ``due_ns``; return when to act again, None at the end."""
        record = self.record
        while record.outcome is None:
            now_ns = self._clock.now_ns()
            waiting = self._open and not self._whole and record.requested_ns is not None
            silent_ns = self._last_token_ns + self._silence_ns if waiting else NEVER
            if now_ns >= silent_ns:
                self._break(now_ns, "silence", f"no token for {self._silence_ns / 1e9:g} s")
                continue
            wake_ns = self._decide(now_ns, min(due_ns, now_ns)) if self._running is None else self._steer(now_ns)
            if wake_ns > now_ns:
                return min(wake_ns, silent_ns)
        return None

    def _decide(self, now_ns: int, due_ns: int) -> int:
        started, requested_ns = len(self.record.skills), self.record.requested_ns
        if self._failure is not None:
            outcome, why = self._failure
            return self._settle(now_ns, outcome, why)
        if started == self._announced:
            return self._settle(now_ns, "completed")
        answer = math.inf if requested_ns is None else self._stepper.decide(self._policy_time_s(now_ns))
        if isinstance(answer, Start):
            self._start(answer, due_ns)
            return 0
        self._hold(now_ns)
        if requested_ns is not None and answer < math.inf:
            # later than now: a time that rounding leaves in the past would be decided again for ever
            return max(requested_ns + math.ceil(answer * 1e9), now_ns + 1)
        return NEVER if self._open else self._settle(now_ns, "short", f"{started} of {self._announced} skills arrived")

    def _steer(self, now_ns: int) -> int:
        """Extend, compress or end the running skill; return when to act again, 0 for at once."""
        run = self.record.skills[-1]
        if self._failure is not None and self._failure[0] in {"aborted", "skill-failed"}:
            return self._abort(now_ns)
        end_ns = run.ordered_ns + run.duration_ns
        if now_ns < end_ns:
            return end_ns
        if self._open and not self._whole and len(self.record.arrivals) == run.index + 1:
            end_ns = run.ordered_ns + max(run.latest_ns, run.duration_ns)
        if now_ns < end_ns:
            if run.until_ns != end_ns:
                self._retime("extend", end_ns)
            return end_ns
        if run.until_ns > now_ns:
            self._retime("compress", now_ns)
        if self._order(True, self._running.ended if self._running else bool):
            self._end(now_ns)
            return 0
        limit_ns = run.until_ns + self._patience_ns
        if now_ns >= limit_ns:
            self._fail("skill-overran", f"{run.call} went on for {self._patience_ns / 1e9:g} s after its end")
            return self._abort(now_ns)
        return limit_ns

    def _start(self, answer: Start, due_ns: int) -> None:
        index = len(self.record.skills)
        arrival_ns, call = self.record.arrivals[index]
        duration_ns, latest_ns = round(answer.duration_s * 1e9), round(answer.latest_s * 1e9)

        def report(error: str = "") -> None:
            self._inbox.put(events.SkillOver(self._clock.now_ns(), index, error))

        ordered_ns = self._clock.now_ns()
        until_ns = ordered_ns + duration_ns
        self._running = self._order(None, lambda: self._robot.start(call, until_ns, report))
        if self._running is None:
            return
        start_ns = self._clock.now_ns()
        self._holding = False
        self._log(start_ns, "start", index)
        self.record.skills.append(
            SkillRun(index, call, arrival_ns, due_ns, ordered_ns, start_ns, duration_ns, latest_ns, until_ns)
        )

    def _retime(self, what: What, end_ns: int) -> None:
        run = self.record.skills[-1]
        run.until_ns = end_ns
        self._log(self._clock.now_ns(), what, run.index)
        if self._running is not None:
            running = self._running
            self._order(None, lambda: running.retime(end_ns))

    def _end(self, at_ns: int, what: What = "end") -> None:
        run = self.record.skills[-1]
        run.end_ns = max(at_ns, run.start_ns)
        self._running = None
        self._log(run.end_ns, what, run.index)

    def _abort(self, now_ns: int) -> int:
        if self._running is not None:
            self._order(None, self._running.abort)
            self._end(now_ns, "abort")
        return 0

    def _hold(self, now_ns: int) -> None:
        if not self._holding:
            self._holding = True
            skills = self.record.skills
            gap = skills[-1].call.skill.gap if skills else self._gap
            self._log(now_ns, "hold", len(skills) - 1)
            self._order(None, lambda: self._robot.hold(gap))

    def _settle(self, now_ns: int, outcome: Outcome, why: str = "") -> int:
        self._hold(now_ns)
        self.record.outcome, self.record.why = outcome, why
        return 0

    def _log(self, at_ns: int, what: What, index: int) -> None:
        self.record.commands.append(RobotCommand(at_ns, what, index))

    def _order(self, otherwise: _T, call: Callable[[], _T]) -> _T:
        try:
            return call()
        except Exception as error:  # noqa: BLE001 - the robot is the user's code and must not end the executor
            self._fail("skill-failed", f"the robot: {type(error).__name__}: {error}")
            return otherwise
