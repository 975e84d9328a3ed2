"""Roll-outs as rows, and the studies: phase diagram, random scenarios, every follower, six numbers varied.

Tokens arrive evenly, so that stream-to-act starts at S0 (closed form: the online rule does the same with even tokens),
and the ego is the bare integrator. For followers and varied numbers each seed draws points of the phase diagram's
plane, by a scrambled Sobol sequence; all followers and numbers use the same points.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.rows import (
    IMPACTS,
    MARGINS,
    AboutRollout,
    FollowerRow,
    RolloutRow,
    SensitivityRow,
    TrajectoryRow,
)
from s2a_bench.harness.timelines.rows import to_ns
from s2a_bench.plan.skillset import GAPS
from s2a_bench.policy import COMPARED, Plans, Schedule, policy
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.metrics import peak_jerk, rms_jerk, sparc, stalls
from s2a_bench.scenario import EGO, ROLES
from s2a_bench.scenario.ccrb import FOLLOWERS
from s2a_bench.scenario.ccrb.cars import NCAP_DECELS_MPS2, NCAP_GAPS_M, OUTCOMES, Cars, start_deadline
from s2a_bench.scenario.ccrb.drive import Trajectory
from s2a_bench.scenario.ccrb.ego import PHASES
from s2a_bench.scenario.ccrb.labels import PAPER
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.outcome import Outcomes
from s2a_bench.scenario.ccrb.studies import Scenes, draw, drive_along, plane, spread, survived
from s2a_bench.scenario.longitudinal import Longitudinal
from s2a_bench.stats.seeds import generator

if TYPE_CHECKING:
    from numpy.typing import NDArray

_TOLERANCE_S = 0.02
"""Shorter stalls are not counted (POLICY section 1)."""


def rollout_rows(
    about: Mapping[str, Any], schedule: Schedule, outcomes: Outcomes, *, motion: Mapping[str, Any] | None = None
) -> Iterator[AboutRollout]:
    """Yield the rows of M roll-outs; a value of ``about`` is common to all, or an array of M."""
    stall_s = stalls(schedule)
    end_s = schedule.start_s[-1] + schedule.duration_s[-1]
    shared = {name: value for name, value in about.items() if not isinstance(value, np.ndarray)}
    each = {name: value for name, value in about.items() if isinstance(value, np.ndarray)}
    found = {metric.name: getattr(outcomes, metric.name) for metric in (*IMPACTS, *MARGINS)}
    for place in range(len(outcomes.code)):
        metrics: dict[str, Any] = {name: _finite(values[place]) for name, values in found.items()}
        yield RolloutRow(
            **shared,
            **{name: value[place].item() for name, value in each.items()},
            start_ns=to_ns(schedule.start_s[0, place]),
            end_ns=to_ns(end_s[place]),
            stalls=int((stall_s[:, place] > _TOLERANCE_S).sum()),
            stall_ns=to_ns(stall_s[:, place].sum()),
            outcome=outcomes.name(place),
            **metrics,
            **(motion or {}),
        )


def motion_of(path: Trajectory) -> dict[str, float]:
    """Return jerk and smoothness of the ego in a single roll-out, from the request to rest or impact."""
    speed = path.speed_mps[:, EGO, 0]
    if len(speed) < 3:  # noqa: PLR2004 - over at once
        return {}
    step_s = float(path.time_s[1])
    return {"rms_jerk": rms_jerk(speed, step_s), "peak_jerk": peak_jerk(speed, step_s), "sparc": sparc(speed, step_s)}


def trajectory_rows(cell: str, path: Trajectory) -> Iterator[TrajectoryRow]:
    """Yield every recorded moment of a single roll-out."""
    cars: dict[str, Any] = {
        f"{role}_{what}": getattr(path, what)[:, place, 0].tolist()
        for what in ("position_m", "speed_mps", "acceleration_mps2")
        for place, role in enumerate(ROLES)
    }
    for step, at_s in enumerate(path.time_s):
        yield TrajectoryRow(
            cell=cell,
            at_ns=to_ns(at_s),
            phase=PHASES[int(path.phase[step, 0])],
            skill=int(path.skill[step, 0]),
            ego_lateral_m=float(path.lateral_m[step, EGO, 0]),
            **{name: values[step] for name, values in cars.items()},
        )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


FORMS: Final = {name: policy(name).foreseeing for name in COMPARED}
SCENES: Final = 1366
"""Scenarios of a block, driven in lock step: about 8,000 roll-outs."""
VARIED: Final[dict[str, tuple[float, ...]]] = {
    "gap_decel_mps2": (3.0, 4.0, 5.0, 6.0, 7.0, 8.0),
    "build_s": (0.2, 0.4, 0.6, 0.8, 1.0, 1.2),
    "reaction_s": (0.7, 0.9, 1.1, 1.3, 1.5, 1.7),
    "ego_jerk_mps3": (5.0, 10.0, 20.0, 30.0, 45.0, 60.0),
    "rear_gap_m": (8.0, 11.0, 14.0, 17.0, 20.0, 24.0),
    "onset_s": (-0.5, -0.25, 0.0, 0.25, 0.5, 1.0),
}


def studies(config: CcrbConfig) -> Iterator[tuple[str, Scenes]]:
    """Yield the studies beside the operating point, with their scenarios."""
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


def study_rows(config: CcrbConfig, study: str, scenes: Scenes) -> Iterator[tuple[int, list[AboutRollout]]]:
    """Drive every scenario with every gap behaviour and policy; yield roll-outs and rows block by block.

    The check on the car behind is one more roll-out a scenario. A policy that never stalls is driven once, with a row
    for every gap behaviour.
    """
    for first in range(0, len(scenes), SCENES):
        yield _block(config, study, scenes.cut(slice(first, first + SCENES)))


def count_blocks(scenes: Scenes) -> int:
    """Return the number of blocks that `study_rows` yields."""
    return -(-len(scenes) // SCENES)


def _block(config: CcrbConfig, study: str, scenes: Scenes) -> tuple[int, list[AboutRollout]]:
    scenario = config.scenario
    cases = [(name, gap) for name, form in FORMS.items() for gap in (GAPS if form.stalls else (scenario.gap,))]
    gaps = np.repeat([gap for _, gap in cases], len(scenes))
    every = scenes.times(len(cases))
    cars = every.cars(gaps, scenario)
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
        "follower_survives": np.tile(survived(scenes, scenes.cars(gaps[: len(scenes)], scenario)), len(cases)),
        "simulator": Longitudinal.name,
        "follower": scenario.follower,
        "gap_behaviour": gaps,
        "reflex": scenario.reflex,
        "lane_change": False,
        "deadline_ns": np.rint(deadline_s * 1e9).astype(np.int64),
        "late": None,
    }
    rows = list(rollout_rows(about, schedule, drive_along(every, cars, schedule)))
    again = [
        replace(row, gap_behaviour=gap, cell=f"{study}/{gap}/{row.policy}")
        for gap in GAPS
        if gap != scenario.gap
        for row in rows
        if not FORMS[row.policy].stalls
    ]
    return len(scenes) + len(rows), rows + again


def schedules(config: CcrbConfig, scenes: Scenes, names: Sequence[str]) -> Schedule:
    """Concatenate the policies' schedules; shorter plans are padded with skills of no length."""
    at, count = scenes.numbers, len(scenes)
    longest = int(at["n_skills"].max())
    start_s = {name: np.empty((longest, count)) for name in FORMS}
    duration_s = {name: np.zeros((longest, count)) for name in FORMS}
    for length in np.unique(at["n_skills"]):
        mine = at["n_skills"] == length
        arrival_s = uniform(at["prompt_s"][mine], at["tokens_per_skill"][mine], at["tokens_per_s"][mine], length)
        nominal_s = np.broadcast_to(at["t_nom_s"][mine], arrival_s.shape)
        plans = Plans(arrival_s, nominal_s, config.timeline.t_min * nominal_s, config.timeline.t_max * nominal_s)
        for name, form in FORMS.items():
            found = form.schedule(plans)
            start_s[name][:length, mine], duration_s[name][:length, mine] = found.start_s, found.duration_s
            start_s[name][length:, mine] = found.start_s[-1] + found.duration_s[-1]
    return Schedule(
        np.concatenate([start_s[name] for name in names], axis=1),
        np.concatenate([duration_s[name] for name in names], axis=1),
    )


def follower_rows(config: CcrbConfig) -> Iterator[tuple[int, list[FollowerRow]]]:
    """Drive every follower in Euro NCAP's combinations; yield roll-outs and rows of each."""
    for follower, front_m, decel in product(FOLLOWERS, NCAP_GAPS_M, NCAP_DECELS_MPS2):
        changed: dict[str, Any] = {"follower": follower, "front_gap_m": front_m, "lead_decel_mps2": decel}
        scenario = config.scenario.but(lane_change=False, **changed)
        seeds, scenes = _points(config, scenario)
        cars = _cars(scenes, scenario)
        safe = survived(scenes, cars)
        codes = _codes(config, scenes, cars)
        paper = _paper(codes)
        yield (
            (len(FORMS) + 1) * len(scenes),
            [
                FollowerRow(
                    cell=f"followers/{follower}/{policy}",
                    policy=policy,
                    gap_behaviour=scenario.gap,
                    seed=None if seed < 0 else int(seed),
                    points=int(mine.sum()),
                    survived=int(safe[mine].sum()),
                    front=int((code[mine] & 1).sum()),
                    rear=int((code[mine] >> 1).sum()),
                    rear_survived=int((code[mine & safe] >> 1).sum()),
                    paper=int(paper[mine].sum()),
                    **changed,
                )
                for policy, code in codes.items()
                for seed in np.unique(seeds)
                for mine in (seeds == seed,)
            ],
        )


def sensitivity_rows(config: CcrbConfig) -> Iterator[tuple[int, list[SensitivityRow]]]:
    """Drive the plane with one number changed at a time; yield roll-outs and rows of each value."""
    scenario = config.scenario.but(lane_change=False)
    seeds, scenes = _points(config, scenario)
    drawn = seeds >= 0
    seeds, scenes = seeds[drawn], Scenes({name: values[drawn] for name, values in scenes.numbers.items()})
    for varied, values in VARIED.items():
        for value in values:
            changed: dict[str, Any] = {varied: np.full(len(scenes), value)}
            cars = replace(_cars(scenes, scenario), **changed)
            paper = _paper(_codes(config, scenes, cars))
            yield (
                len(FORMS) * len(scenes),
                [
                    SensitivityRow(
                        cell=f"sensitivity/{varied}",
                        varied=varied,
                        value=value,
                        follower=scenario.follower,
                        gap_behaviour=scenario.gap,
                        seed=int(seed),
                        points=int((seeds == seed).sum()),
                        paper=int(paper[seeds == seed].sum()),
                    )
                    for seed in np.unique(seeds)
                ],
            )


def _points(config: CcrbConfig, scenario: CcrbOptions) -> tuple[NDArray[np.int64], Scenes]:
    """Return the seeds of the drawn points, and the points; the last is the operating point, of seed -1."""
    from scipy.stats import qmc

    seeds = range(config.seed, config.seed + config.seeds)
    draws = [qmc.Sobol(2, rng=generator(seed, "ccrb", "plane")).random(config.seed_points) for seed in seeds]
    board, point = config.timeline.boards[0], np.zeros((1, 2))
    scenes = spread(
        scenario,
        config.phase_rates,
        config.phase_gaps_m,
        np.concatenate([*draws, point]),
        prompt_s=board.prompt_s,
        tokens_per_skill=config.tokens_per_skill,
    )
    scenes.numbers["tokens_per_s"][-1] = board.tokens_per_s
    scenes.numbers["rear_gap_m"][-1] = scenario.rear_gap_m
    return np.append(np.repeat(np.array(seeds), config.seed_points), -1), scenes


def _cars(scenes: Scenes, scenario: CcrbOptions) -> Cars:
    return scenes.cars(np.full(len(scenes), scenario.gap), scenario)


def _codes(config: CcrbConfig, scenes: Scenes, cars: Cars) -> dict[str, NDArray[np.int64]]:
    every = scenes.times(len(FORMS))
    numbers: dict[str, Any] = {
        name: np.tile(value, len(FORMS))
        for name in (each.name for each in fields(cars))
        if isinstance(value := getattr(cars, name), np.ndarray)
    }
    outcomes = drive_along(every, replace(cars, **numbers), schedules(config, scenes, list(FORMS)))
    return dict(zip(FORMS, np.split(outcomes.code, len(FORMS)), strict=True))


def _paper(codes: dict[str, NDArray[np.int64]]) -> NDArray[np.bool_]:
    held: NDArray[np.bool_] = np.logical_and.reduce(
        [codes[policy] == OUTCOMES.index(outcome) for policy, outcome in PAPER.items()]
    )
    return held
