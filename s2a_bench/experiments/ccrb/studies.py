"""The studies of a CCRB run: phase diagram, and random scenarios.

Tokens arrive evenly, so that stream-to-act starts at S0 (closed form: the online rule does the same with even tokens),
and the ego is the bare integrator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from s2a_bench.experiments.ccrb.drives import metrics_of_drives
from s2a_bench.experiments.ccrb.rows import RolloutRow
from s2a_bench.harness.timelines.rows import to_ns
from s2a_bench.plan.skillset import GAPS
from s2a_bench.policy import COMPARED, Plans, Schedule, policy
from s2a_bench.policy.arrivals import uniform
from s2a_bench.scenario.ccrb.cars import start_deadline
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import Scenes, drive_along, survived
from s2a_bench.scenario.longitudinal import Longitudinal

FORMS: Final = {name: policy(name).foreseeing for name in COMPARED}
SCENES: Final = 1366
"""Scenarios of a block, driven in lock step: about 8,000 roll-outs."""


def drive_block(scenario: CcrbOptions, study: str, scenes: Scenes) -> tuple[int, list[RolloutRow]]:
    """Drive every scenario with every gap behaviour and policy; return the number of roll-outs, and the rows.

    The check on the car behind is one more roll-out a scenario. A policy that never stalls is driven once, with a row
    for every gap behaviour.
    """
    count = len(scenes)
    cases = [(name, gap) for name, form in FORMS.items() for gap in (GAPS if form.stalls else (scenario.gap,))]
    every = scenes.times(len(cases))
    cars = every.cars(np.repeat([gap for _, gap in cases], count), scenario)
    schedule = schedules(scenes, [name for name, _ in cases])
    deadline_s = start_deadline(cars, every.numbers["plan_decel_mps2"])
    survives = survived(scenes, scenes.cars(np.repeat(cases[0][1], count), scenario)).tolist()
    rows = []
    for place, metrics in enumerate(metrics_of_drives(schedule, drive_along(every, cars, schedule))):
        policy, gap = cases[place // count]
        row = RolloutRow(
            **{name: values[place].item() for name, values in every.numbers.items()},
            cell=f"{study}/{gap}/{policy}",
            study=study,
            policy=policy,
            board="",
            title="",
            emulated=True,
            follower_survives=survives[place % count],
            simulator=Longitudinal.name,
            follower=scenario.follower,
            gap_behaviour=gap,
            reflex=scenario.reflex,
            lane_change=False,
            deadline_ns=to_ns(deadline_s[place]),
            **metrics,
        )
        rows.append(row)
    again = [
        replace(row, gap_behaviour=gap, cell=f"{study}/{gap}/{row.policy}")
        for gap in GAPS
        if gap != scenario.gap
        for row in rows
        if not FORMS[row.policy].stalls
    ]
    return count + len(rows), rows + again


def schedules(scenes: Scenes, names: Sequence[str]) -> Schedule:
    """Concatenate the policies' schedules; shorter plans are padded with skills of no length."""
    at, count = scenes.numbers, len(scenes)
    longest = int(at["n_skills"].max())
    start_s = {name: np.empty((longest, count)) for name in FORMS}
    duration_s = {name: np.zeros((longest, count)) for name in FORMS}
    for length in np.unique(at["n_skills"]):
        mine = at["n_skills"] == length
        arrival_s = uniform(at["prompt_s"][mine], at["tokens_per_skill"][mine], at["tokens_per_s"][mine], length)
        nominal_s = np.broadcast_to(at["t_nom_s"][mine], arrival_s.shape)
        plans = Plans(arrival_s, nominal_s, nominal_s, nominal_s)  # the closed forms neither compress nor extend
        for name, form in FORMS.items():
            planned = form.schedule(plans)
            start_s[name][:length, mine], duration_s[name][:length, mine] = planned.start_s, planned.duration_s
            start_s[name][length:, mine] = planned.start_s[-1] + planned.duration_s[-1]
    return Schedule(
        np.concatenate([start_s[name] for name in names], axis=1),
        np.concatenate([duration_s[name] for name in names], axis=1),
    )
