"""The options that runs of answer plans share: the policies, and the requests for plans of a model."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.harness.config import FirstVariants, sampling
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Names, Options, group, option
from s2a_bench.policy import COMPARED, POLICIES, PlanShape, Policy, Timing, policies
from s2a_bench.transport import paths
from s2a_bench.transport.defaults import FOLLOWED


class PolicyOptions(Options):
    PANEL: ClassVar[str] = "Policies"

    policies: Names = option(
        COMPARED,
        f"{', '.join(POLICIES)}, with parameters as in NAME?parameter=value&other=value; several with commas",
        flag="policy",
        min_length=1,
        first=True,
        names=lambda: POLICIES,
    )
    seed: int = option(0, "seed of everything that is drawn", ge=0)

    @cached_property
    def named_policies(self) -> dict[str, Policy]:
        return policies(self.policies)


class PlanRequests(FirstVariants):
    """The requests for plans: one stream of tokens, of an engine that takes a model's time."""

    COMPUTES: ClassVar[str] = "a plan takes a model's time"

    transports: Names = option(
        (FOLLOWED,), "ros, ros/action, http, http/VARIANT, loopback: one, as in latency", flag="transport", names=paths
    )
    engine: EngineConfig = group(
        EngineConfig,
        only=("name", "profile", "model", "mmproj", "chat_template", "threads", "gpu_layers", "pace"),
        first=(),
    )
    requests: int = option(1, "plans requested per cell", ge=1)
    warmup: int = option(1, "first answers, from which policies learn the rate", ge=0)
    timeout_s: float = option(
        60.0, "seconds without a token after which the robot holds", flag="timeout", ge=0.1, le=86_400
    )
    sample_resources_hz: float = sampling(0.0)

    def check(self) -> None:
        super().check()
        if len(self.pipelines) != 1:
            names, field = ", ".join(each.name for each in self.pipelines), "payload" if self.payload else "transport"
            raise UsageError(f"`{field}`: one stream is followed, not {names}; name one, as ros/action or http/binary")
        if self.engine.pace and self.foreign:
            where = f"leave out `{self.foreign}`"
            raise UsageError(f"`pace` needs the package's server, which holds its engine back; {where}")
        if self.engine.pace and self.engine.kind.plays:
            raise UsageError(f"`pace`: `engine` {self.engine.name} has its profile's rate; leave one of them out")

    def require_played(self, skills: str, lengths: tuple[int, ...], fields: str) -> None:
        """Raise UsageError, naming ``fields``, if the engine plays other skills, or other numbers of tokens a skill."""
        played = self.engine.kind.plays
        if played and (skills, lengths) != (played[0], played[1:]):
            raise UsageError(
                f"`engine` {self.engine.name} writes plans of the {played[0]} skills in {played[1]} tokens a skill; "
                f"leave out {fields}"
            )


def check_steppers(policies: Iterable[Policy]) -> None:
    """Raise UsageError for a policy that cannot follow a plan as it arrives."""
    for policy in policies:
        policy.stepper(PlanShape(1, 1, Timing(1.0, 1.0, 1.0)))
