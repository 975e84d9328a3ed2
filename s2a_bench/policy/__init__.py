"""When to act: a policy decides when each skill of a plan starts and how long it runs. Pure: times are arguments.

A policy is a class with a name and a `Policy.stepper`, which follows one plan on a robot, event by event.
`Policy.schedule` decides for plans whose arrivals are known. It drives the stepper unless a policy computes with
arrays, for studies of millions of plans; both give the same result. docs/policies.md defines N skills and M plans;
times are in seconds from the request.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Protocol, TypeAlias

from s2a_bench.policy.parameters import build, canonical
from s2a_bench.registry import Registry
from s2a_bench.stats.seeds import Verbatim
from s2a_bench.types import Timing as Timing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2a_bench.policy.estimator import GapPrior

Floats: TypeAlias = "NDArray[np.float64]"
TOLERANCE_S: Final = 0.02
"""Longer stalls make the robot stop and go; shorter ones are the machine's, not the policy's."""


@dataclass(frozen=True, slots=True)
class Start:
    """Start the next skill now.

    It ends after ``duration_s`` if the next skill has arrived by then, or if none follows (all ``n_skills`` have
    started, or the stream has ended). Otherwise it is held on until the next skill arrives, at most until ``latest_s``
    (>= ``duration_s``) after its start; then the robot stalls.
    """

    duration_s: float
    latest_s: float


@dataclass(frozen=True, slots=True)
class PlanShape:
    """The properties of a plan that are known before its first token."""

    n_skills: int
    tokens_per_skill: float
    """Delimiter included."""
    expected: Timing
    """Durations of a skill whose fragment has not been parsed yet."""
    expected_cv: float = 0.2
    safe_start_s: float | None = None
    """S0, unknown before the last token: set in studies only, for s2a-clairvoyant."""

    @property
    def key(self) -> Verbatim:
        """Return the text that seeds the draws for such plans."""
        return Verbatim(repr(self))


class Stepper(Protocol):
    """One policy following one plan. Times never decrease from call to call.

    Events at the same instant are passed in the order token, fragment, end; a call of `decide` follows.
    """

    def token(self, at_s: float) -> None:
        """Record that a token arrived."""

    def fragment(self, at_s: float, timing: Timing) -> None:
        """Record that the next skill has been parsed."""

    def end(self, at_s: float) -> None:
        """Record that the stream has ended: no skill will follow."""

    def decide(self, now_s: float) -> Start | float:
        """Return what to do while no skill runs: start the next one, or when to decide again (inf: on an event).

        The next call is at that time, or before it at a token, fragment or end. After a Start the skill counts as
        started at ``now_s``; the next call is when it has ended, held on or not.
        """


@dataclass(frozen=True, slots=True)
class Plans:
    """M plans of N skills each, as arrays of shape (N, M), in seconds from the request."""

    arrival_s: Floats
    """t_i, when fragment i is complete; non-decreasing along the first axis."""
    nominal_s: Floats
    least_s: Floats
    most_s: Floats
    token_s: Floats | None = None
    """Arrival of each token, shape (tokens, M), for policies that learn from tokens."""
    shape: PlanShape | None = None
    """Shape common to all M plans, for policies that learn."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Decisions for M plans: arrays of shape (N, M), in seconds; durations include holding on."""

    start_s: Floats
    duration_s: Floats


class Policy(Protocol):
    """A rule for acting; a subclass gets `schedule` from its stepper."""

    stalls: ClassVar[bool] = True
    """Whether a robot that has begun may have to wait for a skill."""
    learns: ClassVar[bool] = False
    """Whether it uses a prior and a lambda learned from other plans, which `informed` sets."""
    colour: ClassVar[str] = ""
    """Colour of its skills in timelines (Okabe and Ito's palette); empty: one is chosen."""

    @property
    def name(self) -> str:
        """Return its name, as in POLICIES."""

    @property
    def prior(self) -> GapPrior:
        from s2a_bench.policy.estimator import VAGUE

        return VAGUE

    @property
    def caution(self) -> float | None:
        """Return lambda, None before calibration; a plan without stalls at one lambda has none at a greater one."""
        return None

    @property
    def foreseeing(self) -> Policy:
        """Return the policy that decides the same where all arrivals are known and tokens come evenly."""
        return self

    def informed(self, prior: GapPrior | None = None, caution: float | None = None) -> Policy:  # noqa: ARG002
        """Return a copy with these values; None keeps the present one."""
        return self

    def stepper(self, shape: PlanShape) -> Stepper:
        """Return a stepper for one plan."""

    def schedule(self, plans: Plans) -> Schedule:
        """Decide for many plans at once; raises ValueError if the stepper needs ``plans.shape`` and it is None."""
        from s2a_bench.policy.stepping import schedule

        return schedule(self, plans)

    def schedules(self, plans: Plans, cautions: Sequence[float]) -> Schedule:
        """Decide with each lambda: arrays of shape (N, lambdas, M)."""
        import numpy as np

        every = [self.informed(caution=caution).schedule(plans) for caution in cautions]
        return Schedule(
            np.stack([each.start_s for each in every], axis=1), np.stack([each.duration_s for each in every], axis=1)
        )


POLICIES: Final[Registry[Callable[..., Policy]]] = Registry(
    "policies",
    "policy",
    {
        "naive": "s2a_bench.policy.nominal:Naive",
        "wait-then-act": "s2a_bench.policy.nominal:WaitThenAct",
        "stream-to-act": "s2a_bench.policy.stream_to_act:StreamToAct",
        "stream-to-act-early": "s2a_bench.policy.stream_to_act:EarlyStart",
        "s2a-clairvoyant": "s2a_bench.policy.nominal:Clairvoyant",
        "s2a-mean": "s2a_bench.policy.stream_to_act:MeanStart",
    },
)
"""Constructor of each policy; all parameters have defaults. Names starting with s2a- are for study."""

ONLINE: Final = "stream-to-act"
"""The paper's rule in the form that a robot can run."""
COMPARED: Final = ("naive", "wait-then-act", ONLINE)
"""Policies that commands compare by default."""
CAUTION: Final = 2.33
"""lambda until it is calibrated: the normal distribution's 99 % quantile."""


def policy(written: str) -> Policy:
    """Build the policy ``name[?parameter=value&...]``; raises UsageError for an unknown name, parameter or value."""
    return build(POLICIES[written.partition("?")[0]], written)


def policies(written: Iterable[str]) -> dict[str, Policy]:
    """Build each policy once, by its canonical name: parameters in their order, those at their default left out."""
    built = ((each.partition("?")[0], policy(each)) for each in written)
    return {canonical(name, each): each for name, each in built}
