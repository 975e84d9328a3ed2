"""Where the ordering of the policies holds: the phase diagram, and random scenarios; always the bare integrator.

Tokens come evenly, so that stream-to-act starts at S0 (closed form: the online rule does the same with even tokens).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

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
from s2a_bench.scenario.ccrb.cars import start_deadline
from s2a_bench.scenario.ccrb.studies import Scenes, draw, drive_along, plane, survived
from s2a_bench.scenario.longitudinal import Longitudinal

FORMS: Final[dict[str, Policy]] = {
    "naive": Naive(),
    "wait-then-act": WaitThenAct(),
    "stream-to-act": Clairvoyant(),
}
"""The paper's three policies with all arrivals known."""
SCENES: Final = 1366
"""Scenarios in lock step: some 8 thousand roll-outs."""


def studies(config: CcrbConfig) -> Iterator[tuple[str, Scenes]]:
    """Yield the studies that are asked for besides the operating point, with their scenarios."""
    if config.phase:
        yield (
            "phase",
            plane(
                config.scenario,
                config.phase_rates,
                config.phase_gaps_m,
                config.phase_points,
                prompt_s=config.timeline.boards[0].prompt_s,
                tokens_per_skill=config.tokens_per_skill,
            ),
        )
    if config.random:
        yield "random", draw(generator(config.seed, "ccrb", "random"), config.random)


def study_rows(config: CcrbConfig, study: str, scenes: Scenes) -> Iterator[tuple[int, list[RolloutRow]]]:
    """Drive every scenario with every gap behaviour and policy: how many were driven, and their rows, piece by piece.

    The check on the car behind is one more drive of each.

    What never stalls has no gap to behave in: it is driven once, and stands in a row for every gap behaviour.
    """
    for first in range(0, len(scenes), SCENES):
        yield _piece(config, study, scenes.cut(slice(first, first + SCENES)))


def pieces(scenes: Scenes) -> int:
    """Return how many pieces of work `study_rows` makes of them."""
    return -(-len(scenes) // SCENES)


def _piece(config: CcrbConfig, study: str, scenes: Scenes) -> tuple[int, list[RolloutRow]]:
    """Drive some scenarios in lock step: naive with each gap behaviour, the others once."""
    asked = config.scenario
    cases = [("naive", gap) for gap in GAPS] + [(name, asked.gap) for name in FORMS if name != "naive"]
    gaps = np.repeat([gap for _, gap in cases], len(scenes))
    every = scenes.times(len(cases))
    cars = every.cars(gaps, asked)
    schedule = schedules(config, scenes, [name for name, _ in cases])
    deadline_s = start_deadline(cars, every.numbers["plan_decel_mps2"])
    about: dict[str, Any] = {
        **every.numbers,
        "cell": np.repeat([f"{study}/{gap}/{name}" for name, gap in cases], len(scenes)),
        "study": study,
        "policy": np.repeat([name for name, _ in cases], len(scenes)),
        "board": "",
        "title": "",
        "emulated": True,
        "follower_survives": np.tile(survived(scenes, scenes.cars(gaps[: len(scenes)], asked)), len(cases)),
        "simulator": Longitudinal.name,
        "follower": asked.follower,
        "gap_behaviour": gaps,
        "reflex": asked.reflex,
        "lane_change": False,
        "deadline_ns": np.rint(deadline_s * 1e9).astype(np.int64),
        "late": None,
    }
    rows = list(rollout_rows(about, schedule, drive_along(every, cars, schedule)))
    again = [
        replace(row, gap_behaviour=gap, cell=f"{study}/{gap}/{row.policy}")
        for gap in GAPS
        if gap != asked.gap
        for row in rows
        if row.policy != "naive"
    ]
    return len(scenes) + len(rows), rows + again


def schedules(config: CcrbConfig, scenes: Scenes, names: Sequence[str]) -> Schedule:
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
