"""Run a stepper in virtual time on plans whose arrivals are known: `Policy.schedule` for policies without arrays.

The simulated robot adds no delay: a skill starts when the policy decides, and runs as `Start` defines.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from s2a_bench.policy import Plans, Policy, Schedule, Start, Stepper, Timing
from s2a_bench.policy.schedule import align, safe_start

ROUNDING_S = 1e-9


@dataclass(frozen=True, slots=True)
class Stream:
    """Arrivals of one plan; the stream ends with the last of them."""

    token_s: Sequence[float]
    arrival_s: Sequence[float]
    timings: Sequence[Timing]

    def events(self) -> list[tuple[float, int, int]]:
        """List the events (time, kind, index) in their order: tokens are of kind 0, fragments 1, the end 2."""
        events = [(at, 0, i) for i, at in enumerate(self.token_s)] + [(at, 1, i) for i, at in enumerate(self.arrival_s)]
        return sorted([*events, (max(events)[0], 2, 0)])


@dataclass(slots=True)
class _Robot:
    stepper: Stepper
    stream: Stream
    n_skills: int
    running: Start | None = None
    starts_s: list[float] = field(default_factory=list)
    durations_s: list[float] = field(default_factory=list)
    arrived: int = 0
    ended: bool = False

    def receive(self, events: Iterable[tuple[float, int, int]]) -> None:
        for now_s, kind, index in events:
            if kind == 0:
                self.stepper.token(now_s)
            elif kind == 1:
                self.stepper.fragment(now_s, self.stream.timings[index])
                self.arrived += 1
            else:
                self.stepper.end(now_s)
                self.ended = True

    def act(self, now_s: float) -> float:
        """End and start what is due, and return when to act next if no event comes before."""
        while True:
            wake_s = self._decide(now_s) if self.running is None else self.starts_s[-1] + self._length_s(self.running)
            if wake_s > now_s:
                return wake_s
            if self.running is not None:
                self.durations_s.append(now_s - self.starts_s[-1])
                self.running = None

    def _decide(self, now_s: float) -> float:
        answer = self.stepper.decide(now_s)
        if not isinstance(answer, Start):
            if not answer > now_s:
                raise ValueError(f"a stepper that decides at {now_s} s wants to decide again at {answer} s")
            return answer
        if self.arrived == len(self.starts_s):
            raise ValueError(f"a stepper starts skill {self.arrived + 1} at {now_s} s, before it has arrived")
        if not 0 <= answer.duration_s <= answer.latest_s + ROUNDING_S:
            raise ValueError(f"a stepper starts a skill that takes {answer.duration_s} s, {answer.latest_s} s at most")
        self.running = answer
        self.starts_s.append(now_s)
        return now_s + self._length_s(answer)

    def _length_s(self, running: Start) -> float:
        next_arrived = self.arrived > len(self.starts_s)
        none_follows = self.ended or len(self.starts_s) == self.n_skills
        return running.duration_s if next_arrived or none_follows else max(running.latest_s, running.duration_s)


def follow(stepper: Stepper, stream: Stream, n_skills: int) -> tuple[list[float], list[float]]:
    """Run a stepper on a stream that should have ``n_skills`` and return starts and durations in s."""
    robot = _Robot(stepper, stream, n_skills)
    wake_s = robot.act(0.0)
    for at_s, events in groupby(stream.events(), key=itemgetter(0)):
        while wake_s < at_s:
            wake_s = robot.act(wake_s)
        robot.receive(events)
        wake_s = robot.act(at_s)
    while wake_s < math.inf:
        wake_s = robot.act(wake_s)
    return robot.starts_s, robot.durations_s


def step(policy: Policy, plans: Plans, column: int = 0, *, missing: int = 0) -> tuple[list[float], list[float]]:
    """Follow one of M plans and return starts and durations in s; ``missing`` more skills are expected than arrive.

    The policy gets S0, which a robot could not know. Raises ValueError for plans without ``shape``.
    """
    if plans.shape is None:
        raise ValueError(f"{policy.name} decides step by step: plans need shape")
    arrays = align(plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s)
    arrival_s, *durations_s = (array[:, column] for array in arrays)
    first_s = float(safe_start(arrays[0][:, [column]], arrays[1][:, [column]])[0])
    shape = replace(plans.shape, n_skills=plans.shape.n_skills + missing, safe_start_s=first_s)
    timings = [Timing(*times) for times in zip(*(each.tolist() for each in durations_s), strict=True)]
    token_s = [] if plans.token_s is None else plans.token_s[:, column].tolist()
    return follow(policy.stepper(shape), Stream(token_s, arrival_s.tolist(), timings), shape.n_skills)


def schedule(policy: Policy, plans: Plans) -> Schedule:
    """Decide for many plans, one after another; raises ValueError if the stepper does not start every skill."""
    start_s, duration_s = np.empty((2, *np.broadcast_shapes(plans.arrival_s.shape, plans.nominal_s.shape)))
    for column in range(start_s.shape[1]):
        starts, durations = step(policy, plans, column)
        if len(durations) != len(start_s):
            raise ValueError(f"{policy.name} ended with {len(durations)} of {len(start_s)} skills")
        start_s[:, column], duration_s[:, column] = starts, durations
    return Schedule(start_s, duration_s)
