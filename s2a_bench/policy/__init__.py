"""When to act: a policy answers when each skill of a plan starts and how long it runs. Pure: time comes in as numbers.

A policy is a class with a name and a `Policy.stepper`, an object that is told what has happened so far, for a robot.
`Policy.schedule` decides for plans whose arrivals are known; it drives the stepper unless a policy has arrays for it,
for studies of millions of plans: both give the same result. The words are those of docs/policies.md: N skills, M plans,
times in seconds from the request.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Protocol, TypeAlias

from s2a_bench.registry import Registry
from s2a_bench.stats.seeds import Verbatim

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2a_bench.policy.estimator import GapPrior

Floats: TypeAlias = "NDArray[np.float64]"


@dataclass(frozen=True, slots=True)
class Timing:
    """How long one skill takes: as planned, at least, at most (by time-scaling it)."""

    nominal_s: float
    least_s: float
    most_s: float


@dataclass(frozen=True, slots=True)
class Start:
    """Start the next skill now.

    It ends after ``duration_s`` if the next skill has arrived by then, or if none follows (all ``n_skills`` have
    started, or the stream has ended); else it is held on until the next arrives, but no longer than ``latest_s``
    (>= ``duration_s``) after its start: then the robot stalls.
    """

    duration_s: float
    latest_s: float


@dataclass(frozen=True, slots=True)
class PlanShape:
    """What is known of a plan before its first token."""

    n_skills: int
    tokens_per_skill: float
    """Delimiter included."""
    expected: Timing
    """Of a skill whose fragment has not been parsed yet."""
    expected_cv: float = 0.2
    safe_start_s: float | None = None
    """S0, which nobody knows before the last token: given in studies only, for s2a-clairvoyant."""

    @property
    def key(self) -> Verbatim:
        """Return what draws for such plans follow from."""
        of = self.expected
        return Verbatim(
            f"PlanShape(n_skills={self.n_skills!r}, tokens_per_skill={self.tokens_per_skill!r}, "
            f"expected=Timing(nominal_s={of.nominal_s!r}, least_s={of.least_s!r}, most_s={of.most_s!r}), "
            f"expected_cv={self.expected_cv!r}, safe_start_s={self.safe_start_s!r})"
        )


class Stepper(Protocol):
    """One policy following one plan. Times never decrease from call to call.

    What happens at the same instant is told in the order token, fragment, end, and then `decide` is asked.
    """

    def token(self, at_s: float) -> None:
        """Learn that a token arrived."""

    def fragment(self, at_s: float, timing: Timing) -> None:
        """Learn that the next skill has been parsed."""

    def end(self, at_s: float) -> None:
        """Learn that the stream has ended: no skill will follow."""

    def decide(self, now_s: float) -> Start | float:
        """Return what to do while no skill runs: start the next one, or when to ask again (inf: on an event).

        It is asked again at that time, and before it at every token, fragment and end. After a Start the policy takes
        the skill as started at ``now_s``; it is asked again when that has ended, held on or not.
        """


@dataclass(frozen=True, slots=True)
class Plans:
    """M plans of N skills each, as arrays of shape (N, M), in seconds from the request."""

    arrival_s: Floats
    """t_i: when fragment i is complete; non-decreasing along the first axis."""
    nominal_s: Floats
    least_s: Floats
    most_s: Floats
    token_s: Floats | None = None
    """When each token arrived, shape (tokens, M), for the policies that learn from tokens."""
    shape: PlanShape | None = None
    """What was known before the first token, for the policies that learn; one for all M plans."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """What a policy makes of M plans: arrays of shape (N, M), in seconds; durations include holding on."""

    start_s: Floats
    duration_s: Floats


class Policy(Protocol):
    """A rule for acting; a subclass of this one gets `schedule` from its stepper."""

    stalls: ClassVar[bool] = True
    """Whether a robot that has begun may have to wait for a skill."""
    learns: ClassVar[bool] = False
    """Whether it goes by a prior and a lambda that are learned from other plans: `informed` returns it with them."""

    @property
    def name(self) -> str:
        """Return its name, as in POLICIES."""

    @property
    def prior(self) -> GapPrior:
        """Return what it expects of the gaps between tokens before the first."""
        from s2a_bench.policy.estimator import VAGUE

        return VAGUE

    @property
    def caution(self) -> float | None:
        """Return its lambda: a plan that does not stall at one does not at a greater one; None: has none yet."""
        return None

    @property
    def foreseeing(self) -> Policy:
        """Return what does the same as it where all arrivals are known and tokens come evenly."""
        return self

    def informed(self, prior: GapPrior | None = None, caution: float | None = None) -> Policy:  # noqa: ARG002
        """Return it with what was learned; None leaves what it has."""
        return self

    def stepper(self, shape: PlanShape) -> Stepper:
        """Follow one plan as it arrives."""

    def schedule(self, plans: Plans) -> Schedule:
        """Decide for many plans at once; step by step they need ``shape``, raises ValueError without."""
        from s2a_bench.policy.stepping import schedule

        return schedule(self, plans)

    def schedules(self, plans: Plans, cautions: Sequence[float]) -> Schedule:
        """Decide with each lambda: arrays of shape (N, lambdas, M)."""
        import numpy as np

        found = [self.informed(caution=caution).schedule(plans) for caution in cautions]
        return Schedule(
            np.stack([each.start_s for each in found], axis=1), np.stack([each.duration_s for each in found], axis=1)
        )


POLICIES: Final[Registry[Callable[..., Policy]]] = Registry(
    "policies",
    "policy",
    {
        "naive": "s2a_bench.policy.naive:Naive",
        "wait-then-act": "s2a_bench.policy.wait_then_act:WaitThenAct",
        "stream-to-act": "s2a_bench.policy.stream_to_act:StreamToAct",
        "stream-to-act-early": "s2a_bench.policy.stream_to_act:EarlyStart",
        "s2a-clairvoyant": "s2a_bench.policy.wait_then_act:Clairvoyant",
        "s2a-mean": "s2a_bench.policy.stream_to_act:MeanStart",
    },
)
"""What builds each policy from its parameters, which all have defaults; names starting with s2a- are for study."""

ONLINE: Final = "stream-to-act"
"""The rule that the paper proposes and a robot can run."""
COMPARED: Final = ("naive", "wait-then-act", ONLINE)
"""What commands compare unless told."""
CAUTION: Final = 2.33
"""lambda until it is calibrated: the normal distribution's 99 % quantile."""


def policy(written: str) -> Policy:
    """Build the policy ``name[?parameter=value&...]``; raises UsageError for an unknown name, parameter or value."""
    from s2a_bench.policy.parameters import build

    return build(POLICIES[written.partition("?")[0]], written)


def policies(written: Iterable[str]) -> dict[str, Policy]:
    """Build each policy once, by its canonical name: parameters in their order, those at their default left out."""
    from s2a_bench.policy.parameters import canonical

    built = ((each.partition("?")[0], policy(each)) for each in written)
    return {canonical(name, each): each for name, each in built}
