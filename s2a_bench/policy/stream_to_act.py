"""stream-to-act online: start as soon as the forecast of the missing skills allows, stretch skills while it is late.

**Forecast.** k tokens have arrived, the last at a_k; skill m + u is u L - (tokens since fragment m) = n tokens away,
and u - 1 skills before it are of unknown duration. With the plan's mean gap mu and its uncertainty v (`estimator`), and
lambda the *caution*, it is expected at

    a_k + n mu + lambda sqrt(n sigma^2 + n^2 v + (u - 1) sigma_T^2).

An overdue token delays the forecast: no skill arrives before now + the forecast of n - 1 tokens.

**Start.** The first instant at which every *mean* forecast (lambda = 0) meets the nominal durations before that skill
and every *cautious* forecast meets the stretched durations before it.

**While running.** At each skill boundary the stretch is the largest (cautious forecast - now) / (nominal durations
until then), at least 1 and at most T_max / T_nom; a skill whose successor is still missing is held on up to T_max.
Where that ratio allows it, a skill is compressed, down to T_min, to recover the time lost by stretching and stalls.

**Variants.** `StartRule` divides the stretch between start and reserve, and switches the detection of rate changes
within the plan (`changes`). After a change the forecast is made anew. At a boundary from which stretching cannot meet
even a favourable forecast (lambda = -FAVOURABLE) the robot holds once, until it can meet the cautious one, instead of
stalling repeatedly.

The stepper computes one plan in plain arithmetic; `online.schedule` does the same for arrays of plans.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, TypeAlias

import numpy as np
from pydantic import Field

from s2a_bench.policy import CAUTION, Plans, PlanShape, Policy, Schedule, Start, Stepper, Timing
from s2a_bench.policy.changes import ChangeWatch
from s2a_bench.policy.conformal import take
from s2a_bench.policy.estimator import VAGUE, GapPrior, Number
from s2a_bench.policy.nominal import Clairvoyant

FAVOURABLE = 2.0
"""Standard deviations by which a favourable forecast is earlier than the mean."""
Caution: TypeAlias = Annotated[float, Field(ge=0)]
"""lambda; infinity waits for the whole plan."""


@dataclass(frozen=True, slots=True)
class StartRule:
    """Parameters in which the variants of the online rule differ."""

    elastic: bool = True
    """Whether skills may be stretched, held on and compressed."""
    spend: float = 0.0
    """Share of the stretch, from nominal to longest durations, that the mean forecast may use at the start."""
    within: float = math.inf
    """Spend only if the start is within this multiple of the plan's nominal duration."""
    start_caution: float = 1.0
    """lambda at the start, over the lambda of stretching."""
    detect: bool = False
    """Whether changes of the rate within the plan are detected."""

    def budget(self, nominal_s: Number, most_s: Number) -> Number:
        """Return the duration that the mean forecast has to meet at the start."""
        return nominal_s if not self.spend else (1 - self.spend) * nominal_s + self.spend * most_s


@dataclass(frozen=True, slots=True)
class StreamToAct(Policy):
    """The online rule; ``prior`` comes from the hardware profile, ``caution`` (lambda) from `conformal.calibrate`."""

    name: ClassVar[str] = "stream-to-act"
    colour: ClassVar[str] = "#009E73"
    learns: ClassVar[bool] = True

    prior: GapPrior = VAGUE
    caution: Caution | None = None
    """None: calibrated if a run has plans for that, else `CAUTION`."""
    detect: bool = False

    def schedule(self, plans: Plans) -> Schedule:
        from s2a_bench.policy.online import schedule

        return schedule(self.prior, self._lambda, plans, self.rule)

    def schedules(self, plans: Plans, cautions: Sequence[float]) -> Schedule:
        from s2a_bench.policy.online import schedule

        count = plans.arrival_s.shape[1]
        copies = take(plans, np.tile(np.arange(count), len(cautions)))
        decided = schedule(self.prior, np.repeat(cautions, count), copies, self.rule)
        shape = (-1, len(cautions), count)
        return Schedule(decided.start_s.reshape(shape), decided.duration_s.reshape(shape))

    def informed(self, prior: GapPrior | None = None, caution: float | None = None) -> StreamToAct:
        return replace(self, prior=prior or self.prior, caution=self.caution if caution is None else caution)

    @property
    def foreseeing(self) -> Policy:
        return Clairvoyant()

    def stepper(self, shape: PlanShape) -> Stepper:
        watch = ChangeWatch(self.prior) if self.detect else None
        return OnlineStepper(self.prior, self._lambda, shape, self.rule, watch)

    @property
    def rule(self) -> StartRule:
        return StartRule(detect=self.detect)

    @property
    def _lambda(self) -> float:
        return CAUTION if self.caution is None else self.caution


@dataclass(frozen=True, slots=True)
class EarlyStart(StreamToAct):
    """Start as soon as the cautious forecast meets the stretched durations: stretching allows an early start."""

    name: ClassVar[str] = "stream-to-act-early"
    colour: ClassVar[str] = ""

    spend: Annotated[float, Field(ge=0, le=1)] = 1.0
    within: Annotated[float, Field(ge=0)] = math.inf
    start_caution: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0

    @property
    def foreseeing(self) -> Policy:
        return self

    @property
    def rule(self) -> StartRule:
        return StartRule(spend=self.spend, within=self.within, start_caution=self.start_caution, detect=self.detect)


@dataclass(frozen=True, slots=True)
class MeanStart(StreamToAct):
    """The simple online rule, for study: start when the mean forecast meets the nominal durations, never stretch."""

    name: ClassVar[str] = "s2a-mean"
    colour: ClassVar[str] = ""

    caution: Caution | None = 0.0

    @property
    def rule(self) -> StartRule:
        return StartRule(elastic=False, detect=self.detect)


@dataclass(slots=True)
class OnlineStepper:
    prior: GapPrior
    caution: float
    shape: PlanShape
    rule: StartRule
    watch: ChangeWatch | None = None
    parsed: list[Timing] = field(default_factory=list)
    started: int = 0
    tokens: int = 0
    since_fragment: int = 0
    first_token_s: float = math.nan
    last_token_s: float = math.nan
    ended: bool = False
    holding: bool = False
    """Whether the robot holds at a boundary, until stretching can meet the cautious forecast."""
    due_s: float = math.nan
    """Start of the next skill if all skills ran at their nominal durations; NaN before the first start."""

    def token(self, at_s: float) -> None:
        if not self.tokens:
            self.first_token_s = at_s
        self.tokens += 1
        self.since_fragment += 1
        self.last_token_s = at_s
        if self.watch is not None:
            self.watch.token(at_s)

    def fragment(self, at_s: float, timing: Timing) -> None:
        if not self.tokens:
            self.first_token_s = self.last_token_s = at_s
        self.since_fragment = 0
        self.parsed.append(timing)

    def end(self, at_s: float) -> None:  # noqa: ARG002 - the time does not matter
        self.ended = True

    def decide(self, now_s: float) -> Start | float:
        if self.started == len(self.parsed):
            return math.inf
        if math.isnan(self.due_s):
            at_s = self._start_s()
            if now_s < at_s:
                return at_s
            self.due_s = now_s
        elif self.watch is not None and self.rule.elastic and now_s < (at_s := self._resume_s(now_s)):
            return at_s
        timing = self.parsed[self.started]
        ratio = self._ratio(now_s, timing) if self.rule.elastic else 1.0
        self.started += 1
        self.due_s += timing.nominal_s
        return Start(ratio * timing.nominal_s, timing.most_s if self.rule.elastic else timing.nominal_s)

    def _missing(self) -> list[tuple[float, int]]:
        """List for each missing skill the tokens until it, and the skills of unknown duration before it."""
        length = self.shape.tokens_per_skill
        next_in = max(length - self.since_fragment, 1.0)
        count = 0 if self.ended else max(self.shape.n_skills - len(self.parsed), 0)
        return [(next_in + unknown * length, unknown) for unknown in range(count)]

    def _forecast(self, tokens: float, unknown: int, caution: float, duration_s: float) -> float:
        """Return the forecast, in s after the last token, for a skill after ``unknown`` ones of ``duration_s`` each."""
        mean, variance = self._learned()
        gap_noise = mean**2 * (tokens * self.prior.token_cv**2 + tokens**2 * variance)
        skill_noise = unknown * (self.shape.expected_cv * duration_s) ** 2
        noise = math.sqrt(gap_noise + skill_noise)
        return tokens * mean + (caution * noise if noise else 0.0)  # zero noise stays zero, also with infinite caution

    def _learned(self) -> tuple[float, float]:
        if self.watch is None:
            return self.prior.learned(float(max(self.tokens - 1, 0)), self.last_token_s - self.first_token_s)
        mean_s, variance = self.watch.learned
        return mean_s.item(), variance.item()

    def _start_s(self) -> float:
        rule, expected = self.rule, self.shape.expected
        nominal_s = sum(timing.nominal_s for timing in self.parsed)
        if not rule.elastic:
            return self._met_s(self.caution, nominal_s, expected.nominal_s)
        most_s = sum(timing.most_s for timing in self.parsed)
        at_s = self._met_s(0.0, rule.budget(nominal_s, most_s), rule.budget(expected.nominal_s, expected.most_s))
        whole_s = nominal_s + len(self._missing()) * expected.nominal_s
        if rule.spend and at_s > rule.within * whole_s:
            at_s = self._met_s(0.0, nominal_s, expected.nominal_s)
        return max(at_s, self._met_s(self.caution * rule.start_caution, most_s, expected.most_s))

    def _resume_s(self, now_s: float) -> float:
        """Return until when to hold at this boundary; a past time if stretching may still be enough."""
        most_s = sum(timing.most_s for timing in self.parsed[self.started :])
        unknown_s = self.shape.expected.most_s
        self.holding = self.holding or self._met_s(-FAVOURABLE, most_s, unknown_s) > now_s
        at_s = self._met_s(self.caution, most_s, unknown_s) if self.holding else -math.inf
        self.holding = now_s < at_s
        return at_s

    def _met_s(self, caution: float, known_s: float, unknown_s: float) -> float:
        """Return from when on the durations before each skill meet its forecast; infinity: not before another token.

        ``known_s`` is the duration of all parsed skills, ``unknown_s`` of each skill after them.
        """
        at_s = -math.inf
        for tokens, unknown in self._missing():
            budget_s = known_s + unknown * unknown_s
            # If the token is overdue then, the forecast moves with the clock: the budget must cover the rest.
            if self._forecast(tokens - 1, unknown, caution, unknown_s) > budget_s:
                return math.inf
            at_s = max(at_s, self.last_token_s + self._forecast(tokens, unknown, caution, unknown_s) - budget_s)
        return at_s

    def _ratio(self, now_s: float, timing: Timing) -> float:
        unknown_s = self.shape.expected.nominal_s
        known_s = sum(timing.nominal_s for timing in self.parsed[self.started :])
        demand = -math.inf
        for tokens, unknown in self._missing():
            pushed_s = now_s + self._forecast(tokens - 1, unknown, self.caution, unknown_s)
            arrival_s = self.last_token_s + self._forecast(tokens, unknown, self.caution, unknown_s)
            demand = max(demand, (max(arrival_s, pushed_s) - now_s) / (known_s + unknown * unknown_s))
        late_s = now_s - self.due_s
        least = min(max(1 - late_s / timing.nominal_s, timing.least_s / timing.nominal_s), 1.0)
        return min(max(demand, least), timing.most_s / timing.nominal_s)
