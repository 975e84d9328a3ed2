"""The online rule of `stream_to_act` for M plans: loops over events and skills, arrays over plans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from s2a_bench.policy import Floats, Plans, Schedule
from s2a_bench.policy.changes import learned_along
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.schedule import align, hold
from s2a_bench.policy.stream_to_act import FAVOURABLE, StartRule

Ints: TypeAlias = NDArray[np.intp]


def schedule(prior: GapPrior, caution: ArrayLike, plans: Plans, rule: StartRule) -> Schedule:
    """Decide for many plans at once; ``caution`` (lambda) is one number or one a plan, shape (M,).

    Plans need ``token_s`` and ``shape``; raises ValueError without. The stream ends with its last token or fragment.
    """
    arrival_s, nominal_s, least_s, most_s = align(plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s)
    cautions = np.broadcast_to(np.asarray(caution, dtype=np.float64), arrival_s.shape[1:])
    stream = _Stream(prior, cautions, plans, rule, arrival_s)
    nominal_sum, most_sum = _sums_before(nominal_s), _sums_before(most_s)
    start_s = np.empty(arrival_s.shape)
    duration_s = np.empty(arrival_s.shape)
    start_s[0] = _first_start(stream, nominal_sum, most_sum)
    for i, now_s in enumerate(start_s):
        duration_s[i] = nominal_s[i]
        if rule.elastic:
            if rule.detect and i:
                now_s[:] = _resume(stream, now_s, most_sum, i)
            late_s = now_s - (start_s[0] + nominal_sum[i])
            least = np.minimum(np.maximum(1 - late_s / nominal_s[i], least_s[i] / nominal_s[i]), 1.0)
            demand = _demand(stream, now_s, nominal_sum, i)
            duration_s[i] *= np.minimum(np.maximum(demand, least), most_s[i] / nominal_s[i])
        if i + 1 < len(start_s):
            np.maximum(now_s + duration_s[i], arrival_s[i + 1], out=start_s[i + 1])
    return Schedule(start_s, hold(arrival_s, start_s, duration_s, most_s) if rule.elastic else duration_s)


def _sums_before(duration_s: Floats) -> Floats:
    """Return the sums over the skills before each skill and over all: shape (N + 1, M)."""
    return np.vstack([np.zeros(duration_s.shape[1]), np.cumsum(duration_s, axis=0)])


class _Stream:
    """Tokens and fragments of M plans in order of time, one event a row, and what the rule knows of them."""

    def __init__(self, prior: GapPrior, caution: Floats, plans: Plans, rule: StartRule, arrival_s: Floats) -> None:
        if plans.token_s is None or plans.shape is None:
            raise ValueError("an online policy learns from tokens: plans need token_s and shape")
        self.prior, self.caution, self.shape, self.rule = prior, caution, plans.shape, rule
        self.token_s = plans.token_s
        # `GapPrior.learned` after each token, where changes of the rate are detected.
        self.learned = learned_along(prior, self.token_s) if rule.detect else None
        both = np.concatenate([self.token_s, arrival_s])
        # Stable: at one instant tokens come before the fragment that they complete.
        order = np.argsort(both, axis=0, kind="stable")
        is_token = order < len(self.token_s)
        self.event_s = np.take_along_axis(both, order, axis=0)
        # Tokens and fragments up to each event.
        self.tokens = np.cumsum(is_token, axis=0)
        self.parsed = np.arange(1, len(both) + 1)[:, np.newaxis] - self.tokens
        # Tokens up to fragment m; row 0 stands for no fragment.
        self.at_fragment = np.zeros((len(arrival_s) + 1, arrival_s.shape[1]), dtype=np.intp)
        self.at_fragment[1:] = self.tokens.T[~is_token.T].reshape(arrival_s.shape[::-1]).T

    def view(self, plans: Ints, event: Ints) -> _View:
        tokens, parsed = self.tokens[event, plans], self.parsed[event, plans]
        last_s = self.token_s[np.maximum(tokens, 1) - 1, plans]
        if self.learned is None:
            mean_s, variance = self.prior.learned(np.maximum(tokens - 1.0, 0.0), last_s - self.token_s[0, plans])
        else:
            mean_s, variance = (each[np.maximum(tokens, 1) - 1, plans] for each in self.learned)
        next_in = np.maximum(self.shape.tokens_per_skill - (tokens - self.at_fragment[parsed, plans]), 1.0)
        missing = np.maximum(self.shape.n_skills - parsed, 0)
        unknown = np.arange(missing.max(initial=0), dtype=np.float64)[:, np.newaxis]
        return _View(self, plans, parsed, missing, last_s, mean_s, variance, next_in, unknown)


@dataclass(frozen=True, slots=True)
class _View:
    """State of some plans after an event: one value per plan, and a row for each missing skill."""

    stream: _Stream
    plans: Ints
    parsed: Ints
    missing: Ints
    last_s: Floats
    mean_s: Floats
    variance: Floats
    """The variance of the mean gap, relative to its square."""
    next_in: Floats
    """Tokens until the next fragment."""
    unknown: Floats
    """Number of skills of unknown duration before each missing one: a column 0, 1, ..."""

    def mean_start_s(self, known_s: Floats, unknown_s: float) -> Floats:
        """Return when the mean forecasts meet the durations before each skill; infinity: not before another token.

        Both grow linearly from skill to skill, so the next skill or the last one decides.
        """
        at_s = np.full(self.plans.shape, -np.inf)
        for unknown in (np.zeros_like(self.next_in), np.maximum(self.missing - 1.0, 0.0)):
            tokens = self.next_in + unknown * self.stream.shape.tokens_per_skill
            budget_s = known_s + unknown * unknown_s
            each_s = self.last_s + tokens * self.mean_s - budget_s
            each_s[(tokens - 1) * self.mean_s > budget_s] = np.inf
            np.maximum(at_s, each_s, out=at_s)
        return np.where(self.missing > 0, at_s, -np.inf)

    def cautious_start_s(self, known_s: Floats, unknown_s: float, caution: Floats) -> Floats:
        forecast_s, overdue_s = self._forecasts(unknown_s, caution)
        budget_s = known_s + self.unknown * unknown_s
        each_s = self.last_s + forecast_s - budget_s
        each_s[overdue_s > budget_s] = np.inf
        return self._worst(each_s)

    def demand(self, now_s: Floats, known_s: Floats, unknown_s: float) -> Floats:
        """Return the largest (cautious forecast - now) / (durations until then); -inf if nothing is missing."""
        forecast_s, overdue_s = self._forecasts(unknown_s, self.caution)
        until_s = np.maximum(self.last_s + forecast_s, now_s + overdue_s) - now_s
        return self._worst(until_s / (known_s + self.unknown * unknown_s))

    @property
    def caution(self) -> Floats:
        return self.stream.caution[self.plans]

    def _forecasts(self, unknown_s: float, caution: Floats) -> tuple[Floats, Floats]:
        """Return the cautious forecasts in s from the last token, and from a token that arrives now."""
        tokens = self.next_in + self.unknown * self.stream.shape.tokens_per_skill
        skills = self.unknown * (self.stream.shape.expected_cv * unknown_s) ** 2
        return self._forecast(tokens, skills, caution), self._forecast(tokens - 1, skills, caution)

    def _forecast(self, tokens: Floats, skills: Floats, caution: Floats) -> Floats:
        gaps = tokens * self.stream.prior.token_cv**2 + tokens**2 * self.variance
        noise = np.sqrt(self.mean_s**2 * gaps + skills)
        # Zero noise stays zero, also with infinite caution.
        np.multiply(noise, caution, out=noise, where=noise > 0)
        return tokens * self.mean_s + noise

    def _worst(self, each: Floats) -> Floats:
        return np.asarray(each.max(axis=0, initial=-np.inf, where=self.unknown < self.missing))


def _first_start(stream: _Stream, nominal_sum: Floats, most_sum: Floats) -> Floats:
    rule, expected = stream.rule, stream.shape.expected

    def at_s(event: int, live: Ints, until_s: Floats) -> Floats:
        view = stream.view(live, np.full(live.shape, event))
        nominal_s, most_s = nominal_sum[view.parsed, live], most_sum[view.parsed, live]
        if not rule.elastic:
            return view.cautious_start_s(nominal_s, expected.nominal_s, view.caution)
        budget_s = rule.budget(nominal_s, most_s)
        start_s = view.mean_start_s(budget_s, rule.budget(expected.nominal_s, expected.most_s))
        if rule.spend and rule.within < np.inf:
            whole_s = nominal_s + view.missing * expected.nominal_s
            start_s = np.where(
                start_s > rule.within * whole_s, view.mean_start_s(nominal_s, expected.nominal_s), start_s
            )
        # The cheap mean forecast rules out most plans; the cautious one is computed for the rest.
        near = np.flatnonzero(start_s < until_s)
        view = stream.view(live[near], np.full(near.shape, event))
        cautious_s = view.cautious_start_s(most_s[near], expected.most_s, rule.start_caution * view.caution)
        start_s[near] = np.maximum(start_s[near], cautious_s)
        return start_s

    waiting = np.arange(nominal_sum.shape[1])
    return _first(stream, waiting, np.full(waiting.shape, -np.inf), at_s)


def _resume(stream: _Stream, now_s: Floats, most_sum: Floats, skill: int) -> Floats:
    """Return when the skill of that number starts: later than now where no forecast is met."""
    unknown_s = stream.shape.expected.most_s
    plans, view = _unfinished(stream, now_s)
    most_s = most_sum[view.parsed, plans] - most_sum[skill, plans]
    favourable = np.full(plans.shape, -FAVOURABLE)
    holding = plans[view.cautious_start_s(most_s, unknown_s, favourable) > now_s[plans]]

    def at_s(event: int, live: Ints, until_s: Floats) -> Floats:  # noqa: ARG001 - no cheaper test
        view = stream.view(live, np.full(live.shape, event))
        return view.cautious_start_s(most_sum[view.parsed, live] - most_sum[skill, live], unknown_s, view.caution)

    start_s = now_s.copy()
    start_s[holding] = _first(stream, holding, now_s[holding], at_s)
    return start_s


def _first(stream: _Stream, plans: Ints, from_s: Floats, at_s: Callable[[int, Ints, Floats], Floats]) -> Floats:
    """Return the first time from ``from_s`` on that ``at_s`` allows, at the latest the last event.

    ``at_s`` takes an event, plans, and the times of their next events.
    """
    start_s: Floats = np.maximum(stream.event_s[-1, plans], from_s)
    waiting = np.arange(plans.size)
    for event in range(len(stream.event_s) - 1):
        begins_s = np.maximum(stream.event_s[event, plans[waiting]], from_s[waiting])
        until_s = stream.event_s[event + 1, plans[waiting]]
        # No start before the first fragment, and no decision between events at one instant.
        ready = (stream.parsed[event, plans[waiting]] > 0) & (begins_s < until_s)
        live, begins_s, until_s = waiting[ready], begins_s[ready], until_s[ready]
        if not live.size:
            continue
        allowed_s = np.maximum(begins_s, at_s(event, plans[live], until_s))
        starts = allowed_s < until_s
        start_s[live[starts]] = allowed_s[starts]
        waiting = np.setdiff1d(waiting, live[starts], assume_unique=True)
    return start_s


def _unfinished(stream: _Stream, now_s: Floats) -> tuple[Ints, _View]:
    """Return the plans with further events, and their present state."""
    plans = np.flatnonzero(now_s < stream.event_s[-1])
    event = (stream.event_s[:, plans] <= now_s[plans]).sum(axis=0) - 1
    return plans, stream.view(plans, event)


def _demand(stream: _Stream, now_s: Floats, nominal_sum: Floats, skill: int) -> Floats:
    """Return each plan's demand when the skill of that number (from 0) starts; -inf after the last event."""
    demand = np.full(now_s.shape, -np.inf)
    plans, view = _unfinished(stream, now_s)
    known_s = nominal_sum[view.parsed, plans] - nominal_sum[skill, plans]
    demand[plans] = view.demand(now_s[plans], known_s, stream.shape.expected.nominal_s)
    return demand
