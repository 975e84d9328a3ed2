"""The online rule of `stream_to_act` for M plans at once: loops over events and skills, arrays over plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from s2a_bench.policy import Plans, PlanShape, Schedule
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.schedule import align, hold

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from s2a_bench.policy import Floats

    Ints: TypeAlias = NDArray[np.intp]


def schedule(prior: GapPrior, caution: ArrayLike, plans: Plans, *, elastic: bool) -> Schedule:
    """Decide for many plans at once; ``caution`` (lambda) is one number or one a plan, shape (M,).

    Plans need ``token_s`` and ``shape``; raises ValueError without. The stream ends with its last token or fragment.
    """
    import numpy as np

    if plans.token_s is None or plans.shape is None:
        raise ValueError("an online policy learns from tokens: plans need token_s and shape")
    arrival_s, nominal_s, least_s, most_s = align(plans.arrival_s, plans.nominal_s, plans.least_s, plans.most_s)
    rule = _Rule(prior, np.broadcast_to(np.asarray(caution, dtype=np.float64), arrival_s.shape[1:]), plans.shape)
    stream = _Stream(plans.token_s, arrival_s)
    nominal_sum, most_sum = _sums_before(nominal_s), _sums_before(most_s)
    start_s = np.empty(arrival_s.shape)
    duration_s = np.empty(arrival_s.shape)
    start_s[0] = _first_start(rule, stream, nominal_sum, most_sum if elastic else None)
    for i, now_s in enumerate(start_s):
        duration_s[i] = nominal_s[i]
        if elastic:
            late_s = np.maximum(now_s - (start_s[0] + nominal_sum[i]), 0.0)
            least = np.minimum(np.maximum(1 - late_s / nominal_s[i], least_s[i] / nominal_s[i]), 1.0)
            demand = _demand(rule, stream, now_s, nominal_sum, i)
            duration_s[i] *= np.minimum(np.maximum(demand, least), most_s[i] / nominal_s[i])
        if i + 1 < len(start_s):
            np.maximum(now_s + duration_s[i], arrival_s[i + 1], out=start_s[i + 1])
    return Schedule(start_s, hold(arrival_s, start_s, duration_s, most_s) if elastic else duration_s)


def _sums_before(duration_s: Floats) -> Floats:
    """Return the sums over the skills before each skill, and over all: shape (N + 1, M)."""
    import numpy as np

    return np.vstack([np.zeros(duration_s.shape[1]), np.cumsum(duration_s, axis=0)])


class _Stream:
    """What has come when: tokens and fragments of M plans in the order of time, one event a row."""

    def __init__(self, token_s: Floats, arrival_s: Floats) -> None:
        """Merge tokens and fragments; at the same instant tokens come first, since fragments are made of them."""
        import numpy as np

        both = np.concatenate([token_s, arrival_s])
        order = np.argsort(both, axis=0, kind="stable")
        is_token = order < len(token_s)
        self.token_s = token_s
        self.event_s = np.take_along_axis(both, order, axis=0)
        # With each event: how many tokens and fragments have come.
        self.tokens = np.cumsum(is_token, axis=0)
        self.parsed = np.arange(1, len(both) + 1)[:, np.newaxis] - self.tokens
        # With fragment m: how many tokens have come; row 0 stands for no fragment.
        self.at_fragment = np.zeros((len(arrival_s) + 1, arrival_s.shape[1]), dtype=np.intp)
        self.at_fragment[1:] = self.tokens.T[~is_token.T].reshape(arrival_s.shape[::-1]).T


@dataclass(frozen=True, slots=True)
class _Rule:
    """What the rule knows before the first token."""

    prior: GapPrior
    caution: Floats
    shape: PlanShape

    def view(self, stream: _Stream, plans: Ints, event: Ints) -> _View:
        """See some of the plans as they are after one of their events each."""
        import numpy as np

        tokens, parsed = stream.tokens[event, plans], stream.parsed[event, plans]
        last_s = stream.token_s[np.maximum(tokens, 1) - 1, plans]
        mean_s, variance = self.prior.learned(np.maximum(tokens - 1.0, 0.0), last_s - stream.token_s[0, plans])
        next_in = np.maximum(self.shape.tokens_per_skill - (tokens - stream.at_fragment[parsed, plans]), 1.0)
        missing = np.maximum(self.shape.n_skills - parsed, 0)
        unknown = np.arange(missing.max(initial=0), dtype=np.float64)[:, np.newaxis]
        return _View(self, plans, parsed, missing, last_s, mean_s, variance, next_in, unknown)


@dataclass(frozen=True, slots=True)
class _View:
    """What some of the plans look like after an event: one value a plan, and a row for each skill that is missing."""

    rule: _Rule
    plans: Ints
    parsed: Ints
    missing: Ints
    last_s: Floats
    mean_s: Floats
    variance: Floats
    """Of the mean gap, relative to its square."""
    next_in: Floats
    """Tokens until the next fragment."""
    unknown: Floats
    """How many skills of unknown duration come before each missing one: a column 0, 1, ..."""

    def mean_start_s(self, known_s: Floats, unknown_s: float) -> Floats:
        """Return when the mean forecasts meet the durations before each skill; infinity where only a token can tell.

        Both grow evenly from skill to skill, so that the next skill or the last one decides.
        """
        import numpy as np

        at_s = np.full(self.plans.shape, -np.inf)
        for unknown in (np.zeros_like(self.next_in), np.maximum(self.missing - 1.0, 0.0)):
            tokens = self.next_in + unknown * self.rule.shape.tokens_per_skill
            budget_s = known_s + unknown * unknown_s
            each_s = self.last_s + tokens * self.mean_s - budget_s
            each_s[(tokens - 1) * self.mean_s > budget_s] = np.inf
            np.maximum(at_s, each_s, out=at_s)
        return np.where(self.missing > 0, at_s, -np.inf)

    def cautious_start_s(self, known_s: Floats, unknown_s: float) -> Floats:
        """Return the same for the cautious forecasts."""
        import numpy as np

        forecast_s, overdue_s = self._forecasts(unknown_s)
        budget_s = known_s + self.unknown * unknown_s
        each_s = self.last_s + forecast_s - budget_s
        each_s[overdue_s > budget_s] = np.inf
        return self._worst(each_s)

    def demand(self, now_s: Floats, known_s: Floats, unknown_s: float) -> Floats:
        """Return the largest (cautious forecast - now) / (durations until then); -inf where nothing is missing."""
        import numpy as np

        forecast_s, overdue_s = self._forecasts(unknown_s)
        until_s = np.maximum(self.last_s + forecast_s, now_s + overdue_s) - now_s
        return self._worst(until_s / (known_s + self.unknown * unknown_s))

    def _forecasts(self, unknown_s: float) -> tuple[Floats, Floats]:
        """Return the cautious forecasts in s from the last token, and those from a token that comes now."""
        tokens = self.next_in + self.unknown * self.rule.shape.tokens_per_skill
        skills = self.unknown * (self.rule.shape.expected_cv * unknown_s) ** 2
        return self._forecast(tokens, skills), self._forecast(tokens - 1, skills)

    def _forecast(self, tokens: Floats, skills: Floats) -> Floats:
        import numpy as np

        gaps = tokens * self.rule.prior.token_cv**2 + tokens**2 * self.variance
        noise = np.sqrt(self.mean_s**2 * gaps + skills)
        # No noise stays none, with infinite caution too.
        np.multiply(noise, self.rule.caution[self.plans], out=noise, where=noise > 0)
        return tokens * self.mean_s + noise

    def _worst(self, each: Floats) -> Floats:
        """Take the largest over the missing skills."""
        import numpy as np

        worst: Floats = each.max(axis=0, initial=-np.inf, where=self.unknown < self.missing)
        return worst


def _first_start(rule: _Rule, stream: _Stream, nominal_sum: Floats, most_sum: Floats | None) -> Floats:
    """Return when each plan starts, shape (M,); without ``most_sum`` the cautious forecast meets nominal durations."""
    import numpy as np

    expected = rule.shape.expected
    start_s: Floats = stream.event_s[-1].copy()  # when all has come there is nothing to wait for
    waiting = np.arange(start_s.size)
    for event in range(len(stream.event_s) - 1):
        from_s, until_s = stream.event_s[event], stream.event_s[event + 1]
        # Nothing to start before the first fragment; nothing is decided between events at one instant.
        live = waiting[(stream.parsed[event, waiting] > 0) & (from_s[waiting] < until_s[waiting])]
        view = rule.view(stream, live, np.full(live.shape, event))
        at_s = from_s[live]
        if most_sum is not None:
            # This demand is cheap and lets few plans through before their time.
            at_s = np.maximum(at_s, view.mean_start_s(nominal_sum[view.parsed, live], expected.nominal_s))
            near = at_s < until_s[live]
            at_s, live = at_s[near], live[near]
            view = rule.view(stream, live, np.full(live.shape, event))
            cautious_s = view.cautious_start_s(most_sum[view.parsed, live], expected.most_s)
        else:
            cautious_s = view.cautious_start_s(nominal_sum[view.parsed, live], expected.nominal_s)
        at_s = np.maximum(at_s, cautious_s)
        starts = at_s < until_s[live]
        start_s[live[starts]] = at_s[starts]
        waiting = np.setdiff1d(waiting, live[starts], assume_unique=True)
    return start_s


def _demand(rule: _Rule, stream: _Stream, now_s: Floats, nominal_sum: Floats, skill: int) -> Floats:
    """Return each plan's demand when the skill of that number (from 0) starts; -inf once all has come."""
    import numpy as np

    demand = np.full(now_s.shape, -np.inf)
    plans = np.flatnonzero(now_s < stream.event_s[-1])
    event = (stream.event_s[:, plans] <= now_s[plans]).sum(axis=0) - 1
    view = rule.view(stream, plans, event)
    known_s = nominal_sum[view.parsed, plans] - nominal_sum[skill, plans]
    demand[plans] = view.demand(now_s[plans], known_s, rule.shape.expected.nominal_s)
    return demand
