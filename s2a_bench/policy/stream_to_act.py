"""stream-to-act online: start as soon as the forecast of the missing skills allows, stretch skills while it is bad.

**Forecast.** k tokens have come, the last at a_k; skill m + u is u L - (tokens since fragment m) = n tokens away, and
u - 1 skills before it are of unknown duration. With the plan's mean gap mu and its uncertainty v (`estimator`), and
lambda the *caution*, it is expected at

    a_k + n mu + lambda sqrt(n sigma^2 + n^2 v + (u - 1) sigma_T^2).

A token that is overdue pushes the forecast: no skill comes before now + the forecast of n - 1 tokens.

**Start.** The first instant at which every *mean* forecast (lambda = 0) meets the nominal durations before that skill
and every *cautious* forecast meets the stretched durations before it.

**While running.** At each skill boundary the stretch is the largest (cautious forecast - now) / (nominal durations
until then), at least 1 and at most T_max / T_nom; a skill whose successor is still missing is held on up to T_max.
Where that ratio allows it, a skill is compressed, down to T_min, to recover what stretching and stalls have cost.

The stepper here is plain arithmetic on one plan; `online.schedule` does the same for arrays of plans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, ClassVar, TypeAlias

from pydantic import Field

from s2a_bench.policy import Plans, PlanShape, Schedule, Start, Timing
from s2a_bench.policy.estimator import VAGUE, GapPrior

if TYPE_CHECKING:
    from s2a_bench.policy import Stepper

CAUTION = 2.33
"""lambda until it is calibrated: the normal distribution's 99 % quantile."""
Caution: TypeAlias = Annotated[float, Field(ge=0)]
"""lambda; infinity waits for the whole plan."""


@dataclass(frozen=True, slots=True)
class StreamToAct:
    """The online rule; ``prior`` comes from the hardware profile, ``caution`` (lambda) from `conformal.calibrate`."""

    name: ClassVar[str] = "stream-to-act"
    elastic: ClassVar[bool] = True
    """Whether skills may be stretched, held on and compressed."""

    prior: GapPrior = VAGUE
    caution: Caution | None = None
    """None: calibrated where a run has plans to do that on, else `CAUTION`."""

    def schedule(self, plans: Plans) -> Schedule:
        """Decide for many plans at once; they need ``token_s`` and ``shape``."""
        from s2a_bench.policy.online import schedule

        return schedule(self.prior, self._lambda, plans, elastic=self.elastic)

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives."""
        return OnlineStepper(self.prior, self._lambda, shape, self.elastic)

    @property
    def _lambda(self) -> float:
        return CAUTION if self.caution is None else self.caution


@dataclass(frozen=True, slots=True)
class MeanStart(StreamToAct):
    """For study, the obvious online rule: start when the mean forecast meets the nominal durations, never stretch."""

    name: ClassVar[str] = "s2a-mean"
    elastic: ClassVar[bool] = False

    caution: Caution | None = 0.0


@dataclass(frozen=True, slots=True)
class QuantileStart(StreamToAct):
    """For study: start when the cautious forecast meets the nominal durations, never stretch."""

    name: ClassVar[str] = "s2a-quantile"
    elastic: ClassVar[bool] = False

    caution: Caution | None = CAUTION


@dataclass(slots=True)
class OnlineStepper:
    """The online rule on one plan."""

    prior: GapPrior
    caution: float
    shape: PlanShape
    elastic: bool
    parsed: list[Timing] = field(default_factory=list)
    started: int = 0
    tokens: int = 0
    since_fragment: int = 0
    first_token_s: float = math.nan
    last_token_s: float = math.nan
    ended: bool = False
    due_s: float = math.nan
    """When the next skill would start had all skills run at their nominal durations; NaN before the first start."""

    def token(self, at_s: float) -> None:
        """Learn a gap."""
        if not self.tokens:
            self.first_token_s = at_s
        self.tokens += 1
        self.since_fragment += 1
        self.last_token_s = at_s

    def fragment(self, at_s: float, timing: Timing) -> None:
        """Queue a skill."""
        if not self.tokens:
            self.first_token_s = self.last_token_s = at_s
        self.since_fragment = 0
        self.parsed.append(timing)

    def end(self, at_s: float) -> None:  # noqa: ARG002 - whenever it comes, nothing is missing any more
        """Expect no more skills."""
        self.ended = True

    def decide(self, now_s: float) -> Start | float:
        """Wait for the start time, then start each skill at once, stretched as the forecast demands."""
        if self.started == len(self.parsed):
            return math.inf
        if math.isnan(self.due_s):
            at_s = self._start_s()
            if now_s < at_s:
                return at_s
            self.due_s = now_s
        timing = self.parsed[self.started]
        ratio = self._ratio(now_s, timing) if self.elastic else 1.0
        self.started += 1
        self.due_s += timing.nominal_s
        return Start(ratio * timing.nominal_s, timing.most_s if self.elastic else timing.nominal_s)

    def _missing(self) -> list[tuple[float, int]]:
        """List the skills to come: how many tokens away, and after how many other skills of unknown duration."""
        length = self.shape.tokens_per_skill
        next_in = max(length - self.since_fragment, 1.0)
        count = 0 if self.ended else max(self.shape.n_skills - len(self.parsed), 0)
        return [(next_in + unknown * length, unknown) for unknown in range(count)]

    def _forecast(self, tokens: float, unknown: int, caution: float, duration_s: float) -> float:
        """Return the forecast, in s after the last token, for a skill after ``unknown`` ones of ``duration_s`` each."""
        gaps = max(self.tokens - 1, 0)
        mean, variance = self.prior.learned(float(gaps), self.last_token_s - self.first_token_s)
        gap_noise = mean**2 * (tokens * self.prior.token_cv**2 + tokens**2 * variance)
        skill_noise = unknown * (self.shape.expected_cv * duration_s) ** 2
        noise = math.sqrt(gap_noise + skill_noise)
        return tokens * mean + (caution * noise if noise else 0.0)  # no noise stays none, with infinite caution too

    def _start_s(self) -> float:
        """Return the start time as things stand now; infinity where only another token can tell."""
        expected = self.shape.expected
        nominal_s = sum(timing.nominal_s for timing in self.parsed)
        most_s = sum(timing.most_s for timing in self.parsed)
        demands = (
            [(0.0, nominal_s, expected.nominal_s), (self.caution, most_s, expected.most_s)]
            if self.elastic
            else [(self.caution, nominal_s, expected.nominal_s)]
        )
        at_s = -math.inf
        for tokens, unknown in self._missing():
            for caution, known_s, unknown_s in demands:
                budget_s = known_s + unknown * unknown_s
                # Overdue at that time: the forecast moves on with the clock, so the budget must cover its rest.
                if self._forecast(tokens - 1, unknown, caution, unknown_s) > budget_s:
                    return math.inf
                at_s = max(at_s, self.last_token_s + self._forecast(tokens, unknown, caution, unknown_s) - budget_s)
        return at_s

    def _ratio(self, now_s: float, timing: Timing) -> float:
        """Return by how much to scale the next skill's nominal duration."""
        unknown_s = self.shape.expected.nominal_s
        known_s = sum(timing.nominal_s for timing in self.parsed[self.started :])
        demand = -math.inf
        for tokens, unknown in self._missing():
            pushed_s = now_s + self._forecast(tokens - 1, unknown, self.caution, unknown_s)
            arrival_s = self.last_token_s + self._forecast(tokens, unknown, self.caution, unknown_s)
            demand = max(demand, (max(arrival_s, pushed_s) - now_s) / (known_s + unknown * unknown_s))
        late_s = max(now_s - self.due_s, 0.0)
        least = min(max(1 - late_s / timing.nominal_s, timing.least_s / timing.nominal_s), 1.0)
        return min(max(demand, least), timing.most_s / timing.nominal_s)
