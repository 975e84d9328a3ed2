"""Many scenarios in lock step along the lane: a plane over rate and rear gap, and random ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from s2a_bench.policy import Schedule
from s2a_bench.scenario.ccrb.cars import EGO_LEAST_MPS2, LEAST_IMPACT_MPS, Cars, DrivingPlan, braking_plan, plan_decel
from s2a_bench.scenario.ccrb.drive import drive, follower_survives
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.outcome import Outcomes
from s2a_bench.scenario.longitudinal import Longitudinal

RANGES: Final[dict[str, tuple[float, float]]] = {
    "tokens_per_s": (1.0, 20.0),
    "prompt_s": (0.1, 1.0),
    "t_nom_s": (0.5, 1.5),
    "speed_mps": (30 / 3.6, 80 / 3.6),
    "front_gap_m": (12.0, 60.0),
    "lead_decel_mps2": (2.0, 6.0),
    "rear_gap_m": (6.0, 30.0),
    "reaction_s": (0.7, 1.8),
}
"""Ranges of random scenarios, drawn uniformly; the rate on a logarithmic scale."""
LENGTHS: Final = (1, 2, 3, 4, 5, 6)
SKILLS: Final = (3, 4, 5, 6, 8)
OF_CARS: Final = ("front_gap_m", "lead_decel_mps2", "rear_gap_m", "reaction_s", "speed_mps")


@dataclass(frozen=True, slots=True)
class Scenes:
    """M scenarios: arrays of shape (M,), named as in `Cars` and as in the columns of plans."""

    numbers: dict[str, Any]

    def __len__(self) -> int:
        return len(self.numbers["n_skills"])

    def cut(self, part: slice) -> Scenes:
        return Scenes({name: values[part] for name, values in self.numbers.items()})

    def times(self, count: int) -> Scenes:
        return Scenes({name: np.tile(values, count) for name, values in self.numbers.items()})

    def cars(self, gap: NDArray[np.str_], options: CcrbOptions) -> Cars:
        numbers = {name: self.numbers[name] for name in OF_CARS}
        return Cars(**numbers, gap=gap, follower=options.follower, reflex=options.reflex)


def plane(
    options: CcrbOptions,
    rates: Sequence[float],
    gaps_m: Sequence[float],
    points: tuple[int, int],
    *,
    prompt_s: float,
    tokens_per_skill: int,
) -> Scenes:
    """Return a grid over rate and rear gap, each (from, to), the rate on a logarithmic scale."""
    axes = (np.linspace(0.0, 1.0, number) for number in points)
    along, aside = (values.ravel() for values in np.meshgrid(*axes, indexing="ij"))
    (slow, fast), (near, far) = rates, gaps_m
    rate, gap = slow * (fast / slow) ** along, near + (far - near) * aside
    cars = options.cars
    fixed = {
        "prompt_s": prompt_s,
        "tokens_per_skill": tokens_per_skill,
        "n_skills": options.n_skills,
        "t_nom_s": options.durations.nominal_s,
        **{name: getattr(cars, name) for name in OF_CARS},
    }
    numbers = {name: np.full(rate.shape, value) for name, value in fixed.items()}
    decel = options.plan_decel_mps2 or plan_decel(cars, options.n_skills, options.durations.nominal_s)
    numbers["plan_decel_mps2"] = np.full(rate.shape, decel)
    return Scenes({**numbers, "tokens_per_s": rate, "rear_gap_m": gap, "draw": np.arange(len(rate))})


def draw(rng: np.random.Generator, count: int) -> Scenes:
    """Draw random scenarios; skills are lengthened where a plan exceeds the ego's braking."""
    numbers: dict[str, Any] = {
        name: rng.uniform(low, high, count) for name, (low, high) in RANGES.items() if name != "tokens_per_s"
    }
    low, high = np.log(RANGES["tokens_per_s"])
    numbers["tokens_per_s"] = np.exp(rng.uniform(low, high, count))
    numbers["tokens_per_skill"] = rng.choice(np.array(LENGTHS), count)
    n_skills = numbers["n_skills"] = rng.choice(np.array(SKILLS), count)
    numbers["draw"] = np.arange(count)
    least_s = numbers["speed_mps"] / (n_skills * -EGO_LEAST_MPS2 * 0.75)
    numbers["t_nom_s"] = np.maximum(numbers["t_nom_s"], least_s)
    numbers["plan_decel_mps2"] = numbers["speed_mps"] / (n_skills * numbers["t_nom_s"])
    return Scenes(numbers)


def survived(scenes: Scenes, cars: Cars) -> NDArray[np.bool_]:
    """Return a mask of the scenarios in which the trailing car passes its check."""
    return follower_survives(cars, _plan(scenes, cars), scenes.numbers["n_skills"], scenes.numbers["t_nom_s"])


def drive_along(scenes: Scenes, cars: Cars, schedule: Schedule) -> Outcomes:
    """Drive the scenarios with the bare integrator; the least rear gap is NaN without an impact.

    The trailing car counts as stopped when it is too slow for an impact, although the gap still shrinks.
    """
    outcomes = drive(Longitudinal(), cars, _plan(scenes, cars), schedule, resting_mps=LEAST_IMPACT_MPS).outcomes
    outcomes.min_rear_gap_m[np.isnan(outcomes.rear_impact_mps)] = np.nan
    return outcomes


def _plan(scenes: Scenes, cars: Cars) -> DrivingPlan:
    at = scenes.numbers
    return braking_plan(cars, int(at["n_skills"].max()), at["t_nom_s"], decel_mps2=at["plan_decel_mps2"])
