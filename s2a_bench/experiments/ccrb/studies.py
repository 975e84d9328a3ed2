"""Where the ordering of the policies holds: the phase diagram, and random scenarios; always the bare integrator.

Tokens come evenly, so that stream-to-act starts at S0 (closed form: the online rule does the same with even tokens).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.rows import RolloutRow
from s2a_bench.experiments.ccrb.to_rows import rollout_rows
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.plan.skillset import GAPS
from s2a_bench.policy import Plans, Policy, Schedule
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.clairvoyant import Clairvoyant
from s2a_bench.policy.naive import Naive
from s2a_bench.policy.wait_then_act import WaitThenAct
from s2a_bench.scenario.ccrb.cars import (
    EGO_LEAST_MPS2,
    LEAST_IMPACT_MPS,
    Cars,
    braking_plan,
    plan_decel,
    start_deadline,
)
from s2a_bench.scenario.ccrb.drive import drive
from s2a_bench.scenario.longitudinal import Longitudinal

if TYPE_CHECKING:
    pass

FORMS: Final[dict[str, Policy]] = {
    "naive": Naive(),
    "wait-then-act": WaitThenAct(),
    "stream-to-act": Clairvoyant(),
}
"""The paper's three policies with all arrivals known."""
SCENES: Final = 1366
"""Scenarios in lock step: some 8 thousand roll-outs."""
RESTING_MPS: Final = LEAST_IMPACT_MPS
"""The trailing car counts as stopped: at rest the ego cannot be hit any more, but the gap still shrinks."""

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
"""What random scenarios are drawn from, uniformly; the rate on a logarithmic scale."""
LENGTHS: Final = (1, 2, 3, 4, 5, 6)
SKILLS: Final = (3, 4, 5, 6, 8)


@dataclass(frozen=True, slots=True)
class Scenes:
    """M scenarios: arrays of shape (M,) by the names of `RolloutRow`."""

    numbers: dict[str, Any]

    def __len__(self) -> int:
        return len(self.numbers["n_skills"])

    def cut(self, part: slice) -> Scenes:
        """Take some of them."""
        return Scenes({name: values[part] for name, values in self.numbers.items()})


def phase_scenes(config: CcrbConfig) -> Scenes:
    """Lay rate and rear gap out as a grid, the rate on a logarithmic scale; the rest is the operating point."""
    points = config.phase_points
    rates = np.geomspace(config.phase_rates[0], config.phase_rates[1], points[0])
    gaps = np.linspace(config.phase_gaps_m[0], config.phase_gaps_m[1], points[1])
    rate, gap = (values.ravel() for values in np.meshgrid(rates, gaps, indexing="ij"))
    board, cars = config.timeline.boards[0], config.cars
    fixed = {
        "prompt_s": board.prompt_s,
        "tokens_per_skill": config.tokens_per_skill,
        "n_skills": config.n_skills,
        "t_nom_s": config.durations.nominal_s,
        "speed_mps": cars.speed_mps,
        "front_gap_m": cars.front_gap_m,
        "lead_decel_mps2": cars.lead_decel_mps2,
        "reaction_s": cars.reaction_s,
    }
    numbers = {name: np.full(rate.shape, value) for name, value in fixed.items()}
    decel = plan_decel(cars, config.n_skills, config.durations.nominal_s)
    numbers["plan_decel_mps2"] = np.full(
        rate.shape, float(decel) if config.plan_decel_mps2 is None else config.plan_decel_mps2
    )
    return Scenes({**numbers, "draw": np.arange(len(rate)), "tokens_per_s": rate, "rear_gap_m": gap})


def random_scenes(config: CcrbConfig) -> Scenes:
    """Draw scenarios.

    A plan that the ego cannot follow (more than its full braking) is not drawn: its skills get longer.
    """
    rng = generator(config.seed, "ccrb", "random")
    count = config.random
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


def study_rows(config: CcrbConfig, study: str, scenes: Scenes) -> Iterator[tuple[int, list[RolloutRow]]]:
    """Drive every scenario with every gap behaviour and policy: how many were driven, and their rows, piece by piece.

    What never stalls has no gap to behave in: it is driven once, and stands in a row for every gap behaviour.
    """
    for first in range(0, len(scenes), SCENES):
        yield _piece(config, study, scenes.cut(slice(first, first + SCENES)))


def pieces(scenes: Scenes) -> int:
    """Return how many pieces of work `study_rows` makes of them."""
    return -(-len(scenes) // SCENES)


def _piece(config: CcrbConfig, study: str, scenes: Scenes) -> tuple[int, list[RolloutRow]]:
    """Drive some scenarios in lock step: naive with each gap behaviour, the others once."""
    cases = [("naive", gap) for gap in GAPS] + [(name, config.gap_behaviour) for name in FORMS if name != "naive"]
    at = {name: np.tile(values, len(cases)) for name, values in scenes.numbers.items()}
    cars = Cars(
        front_gap_m=at["front_gap_m"],
        lead_decel_mps2=at["lead_decel_mps2"],
        rear_gap_m=at["rear_gap_m"],
        reaction_s=at["reaction_s"],
        speed_mps=at["speed_mps"],
        gap=np.repeat([gap for _, gap in cases], len(scenes)),
        follower=config.follower,
        reflex=config.reflex,
    )
    schedule = _schedules(config, scenes, [name for name, _ in cases])
    plan = braking_plan(cars, int(at["n_skills"].max()), at["t_nom_s"], decel_mps2=at["plan_decel_mps2"])
    outcomes = drive(Longitudinal(), cars, plan, schedule, resting_mps=RESTING_MPS).outcomes
    outcomes.min_rear_gap_m[np.isnan(outcomes.rear_impact_mps)] = np.nan
    about: dict[str, Any] = {
        **at,
        "deadline_ns": np.rint(start_deadline(cars, at["plan_decel_mps2"]) * 1e9).astype(np.int64),
        "study": study,
        "board": "",
        "title": "",
        "emulated": True,
        "simulator": Longitudinal.name,
        "follower": config.follower,
        "reflex": config.reflex,
        "lane_change": False,
        "late": None,
    }
    names = {
        "cell": np.repeat([f"{study}/{gap}/{name}" for name, gap in cases], len(scenes)),
        "policy": np.repeat([name for name, _ in cases], len(scenes)),
        "gap_behaviour": cars.gap,
    }
    rows = list(rollout_rows({**about, **names}, schedule, outcomes))
    others = [gap for gap in GAPS if gap != config.gap_behaviour]
    again = [
        replace(row, gap_behaviour=gap, cell=f"{study}/{gap}/{row.policy}")
        for gap in others
        for row in rows
        if row.policy != "naive"
    ]
    return len(rows), rows + again


def _schedules(config: CcrbConfig, scenes: Scenes, names: Sequence[str]) -> Schedule:
    """Ask the policies, and put the answers side by side; a shorter plan goes on with skills of no length."""
    at, count = scenes.numbers, len(scenes)
    longest = int(at["n_skills"].max())
    start_s = {name: np.empty((longest, count)) for name in FORMS}
    duration_s = {name: np.zeros((longest, count)) for name in FORMS}
    for length in np.unique(at["n_skills"]):
        mine = at["n_skills"] == length
        arrival_s = uniform(at["prompt_s"][mine], at["tokens_per_skill"][mine], at["tokens_per_s"][mine], length)
        nominal_s = np.broadcast_to(at["t_nom_s"][mine], arrival_s.shape)
        plans = Plans(arrival_s, nominal_s, config.timeline.t_min * nominal_s, config.timeline.t_max * nominal_s)
        for name, policy in FORMS.items():
            found = policy.schedule(plans)
            start_s[name][:length, mine], duration_s[name][:length, mine] = found.start_s, found.duration_s
            start_s[name][length:, mine] = found.start_s[-1] + found.duration_s[-1]
    return Schedule(
        np.concatenate([start_s[name] for name in names], axis=1),
        np.concatenate([duration_s[name] for name in names], axis=1),
    )
