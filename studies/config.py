"""What may be chosen of a study, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

from s2a_bench.boards.profile import load_profile
from s2a_bench.errors import UsageError
from s2a_bench.options import Options, option
from s2a_bench.policy.conformal import CEILING, CONFIDENCE, GUARANTEE, PLANS, Guarantee, check, upper_bound
from s2a_bench.store.manifest import RunWarning

if TYPE_CHECKING:
    from studies.rows import StudyRow

Cell: TypeAlias = "Callable[[], Sequence[StudyRow]]"
"""Independent work of a study: a partial of a module's function, so that another process can run it."""


class StudyConfig(Options):
    """Which study, on how many plans."""

    name: str = option(..., "the study", argument=True)
    plans: int | None = option(None, "plans a cell [default: the study's own number]", ge=1)
    calibration_plans: int = option(400, "plans that prior and lambda come from")
    epsilon: float = option(0.01, "share of plans that may stall")
    guarantee: Guarantee = GUARANTEE
    profile: str = option("", "profile whose recorded gaps the frontier adds as a family")
    seed: int = option(0, "seed; every cell has its own from it", ge=0)
    seeds: int = option(1, "run the whole study for as many seeds, this and the following ones", ge=1, le=1000)
    jobs: int = option(1, "processes", ge=1)

    @cached_property
    def recording(self) -> tuple[float, ...]:
        """Read the profile's recorded gaps, in their order; raises UsageError for a profile that there is not."""
        return load_profile(self.profile).trace_s if self.profile else ()

    def check(self) -> None:
        """Refuse what makes no sense together; raises UsageError naming the fields."""
        check(self.calibration_plans, self.epsilon)
        if self.profile and not self.recording:
            raise UsageError(f"`profile`: {self.profile} holds no recorded gaps; measure one with s2a-bench profile")

    def warnings(self) -> list[RunWarning]:
        """Return what is allowed and worth a warning."""
        if upper_bound(0, self.calibration_plans, CONFIDENCE) <= CEILING * self.epsilon:
            return []
        message = (
            f"{self.calibration_plans} calibration plans are few: one lambda may stall up to "
            f"{upper_bound(0, self.calibration_plans, CONFIDENCE):.1%} of its plans"
        )
        return [RunWarning("few-calibration-plans", message, f"take {PLANS} or more")]

    def to_manifest(self) -> dict[str, Any]:
        """Return the options as plain data, with the recorded gaps that a profile's name stands for."""
        return {"study": self.name, **self.model_dump(exclude={"name"}), "recording": self.recording}
