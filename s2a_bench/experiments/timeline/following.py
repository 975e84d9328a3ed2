"""Policies from plan to plan in executed runs: those that follow their lambda learn from every plan that came whole.

What they have learned can be kept in a file, so that the next run on the same machine goes on from there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.errors import UsageError
from s2a_bench.experiments.study.worlds import generator, with_skills
from s2a_bench.experiments.timeline.config import MOST_CV
from s2a_bench.policy import Plans, PlanShape, Policy
from s2a_bench.policy.conformal import PLANS
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.evaluate import TOLERANCE_S
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.policy.tracking import Tracked
from s2a_bench.runtime.record import observed

if TYPE_CHECKING:
    from s2a_bench.runtime.record import Record

SCHEMA: Final = "s2a-bench-tracking/1"
MOST_BYTES: Final = 10_000_000


@dataclass(slots=True)
class Following:
    """The policies of one setting, and the trackers of those that follow their lambda, by their names."""

    shape: PlanShape
    made: Mapping[str, Policy]
    tracked: dict[str, Tracked] = field(default_factory=dict)
    file: Path | None = None

    def __post_init__(self) -> None:
        """Go on from the file, where there is one that knows this setting."""
        for name, tracked in self.tracked.items():
            if (state := read(self.file).get(self._key(name))) is not None:
                try:
                    self.tracked[name] = Tracked.resume(tracked.made, state)
                except UsageError as error:
                    raise UsageError(f"`track_file`: {self.file}: {self._key(name)} {error}") from error

    def policies(self) -> dict[str, Policy]:
        """Return the policies for the next plan."""
        return {name: self.tracked[name].policy if name in self.tracked else each for name, each in self.made.items()}

    def learn(self, records: Sequence[Record]) -> None:
        """Learn from a plan that was executed; what did not come whole teaches nothing."""
        for record in records:
            plan = observed(record, self.shape)
            if plan is not None and record.policy in self.tracked:
                stalled = any(stall_ns > TOLERANCE_S * 1e9 for stall_ns in record.stalls_ns)
                self.tracked[record.policy].learn(plan, stalled=stalled)
        self._keep()

    def learn_plan(self, plan: Plans, stalled: Mapping[str, bool]) -> None:
        """Learn from a plan that the policies decided without an executor."""
        for name, tracked in self.tracked.items():
            tracked.learn(plan, stalled=stalled[name])
        self._keep()

    def _keep(self) -> None:
        """Write the file anew, with what others have put there."""
        if self.file is None:
            return
        kept = read(self.file) | {self._key(name): tracked.state() for name, tracked in self.tracked.items()}
        part = self.file.with_name(f"{self.file.name}.part")
        part.write_text(json.dumps({"schema": SCHEMA, "policies": kept}) + "\n", encoding="utf-8")
        part.replace(self.file)

    def _key(self, name: str) -> str:
        shape = self.shape
        return f"L{shape.tokens_per_skill:g}/N{shape.n_skills}/T{shape.expected.nominal_s:g}/{name}"


def follow_live(
    policies: Mapping[str, Policy], shape: PlanShape, epsilon: float, seed: int, file: Path | None
) -> Following:
    """Follow the lambda of all policies that were not told one, beginning with plans drawn from their prior."""
    tracked = {}
    for name, policy in policies.items():
        if isinstance(policy, StreamToAct) and policy.caution is None:
            plans = drawn(policy.prior, shape, generator(seed, "tracking", shape), PLANS)
            tracked[name] = Tracked.begin(policy, plans, epsilon)
    return Following(shape, policies, tracked, file)


def drawn(prior: GapPrior, shape: PlanShape, rng: np.random.Generator, plans: int) -> Plans:
    """Draw plans as a prior expects them: lognormal rates and gaps, uniform durations."""

    def lognormal(cv: float, *size: int) -> Any:
        variance = np.log1p(cv**2)
        return rng.lognormal(-variance / 2, np.sqrt(variance), size)

    gaps_s = (
        prior.mean_s
        * lognormal(prior.plan_cv, plans)
        * lognormal(prior.token_cv, shape.n_skills * int(shape.tokens_per_skill), plans)
    )
    even = replace(shape, expected_cv=min(shape.expected_cv, MOST_CV))
    return replace(with_skills(np.cumsum(gaps_s, axis=0), even, rng), shape=shape)


def read(file: Path | None) -> dict[str, Any]:
    """Return the states in a file, none where there is no file; raises UsageError for another file."""
    if file is None:
        return {}
    if not file.parent.is_dir():
        raise UsageError(f"`track_file`: there is no folder {file.parent}; make it, or name another file")
    if not file.exists():
        return {}
    try:
        if file.stat().st_size > MOST_BYTES:
            raise UsageError(f"`track_file`: {file} is larger than {MOST_BYTES // 1_000_000} MB; name another file")
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"`track_file`: {file}: {error}; name another file, or a new one") from error
    if not isinstance(found, dict) or found.get("schema") != SCHEMA or not isinstance(found.get("policies"), dict):
        raise UsageError(f"`track_file`: {file} was not written by --track-file; name another file, or a new one")
    states: dict[str, Any] = found["policies"]
    return states
