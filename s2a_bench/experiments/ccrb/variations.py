"""How far the paper's ordering hangs on who is behind, and on six numbers that nobody told: points of the plane, drawn.

Every seed draws its own points of the phase diagram's plane, by a scrambled Sobol sequence; followers, Euro NCAP's
combinations and the varied numbers all meet the same points. Tokens come evenly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.rows import FollowerRow, SensitivityRow
from s2a_bench.experiments.ccrb.studies import FORMS, schedules
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.scenario.ccrb import FOLLOWERS
from s2a_bench.scenario.ccrb.cars import NCAP_DECELS_MPS2, NCAP_GAPS_M, OUTCOMES, Cars
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import Scenes, drive_along, spread, survived
from s2a_bench.scenario.ccrb.words import PAPER

if TYPE_CHECKING:
    from numpy.typing import NDArray


VARIED: Final[dict[str, tuple[float, ...]]] = {
    "gap_decel_mps2": (3.0, 4.0, 5.0, 6.0, 7.0, 8.0),
    "build_s": (0.2, 0.4, 0.6, 0.8, 1.0, 1.2),
    "reaction_s": (0.7, 0.9, 1.1, 1.3, 1.5, 1.7),
    "ego_jerk_mps3": (5.0, 10.0, 20.0, 30.0, 45.0, 60.0),
    "rear_gap_m": (8.0, 11.0, 14.0, 17.0, 20.0, 24.0),
    "onset_s": (-0.5, -0.25, 0.0, 0.25, 0.5, 1.0),
}
"""Numbers of `Cars` that are varied one at a time, and their values."""


def follower_rows(config: CcrbConfig) -> Iterator[tuple[int, list[FollowerRow]]]:
    """Drive every follower in Euro NCAP's combinations: roll-outs and rows, combination by combination."""
    for follower, front_m, decel in product(FOLLOWERS, NCAP_GAPS_M, NCAP_DECELS_MPS2):
        changed: dict[str, Any] = {"follower": follower, "front_gap_m": front_m, "lead_decel_mps2": decel}
        asked = config.scenario.but(lane_change=False, **changed)
        seeds, scenes = _points(config, asked)
        cars = scenes.cars(_gaps(scenes, asked), asked)
        safe = survived(scenes, cars)
        codes = _codes(config, scenes, cars)
        paper = _paper(codes)
        yield (
            (len(FORMS) + 1) * len(scenes),
            [
                FollowerRow(
                    cell=f"followers/{follower}/{policy}",
                    policy=policy,
                    gap_behaviour=asked.gap,
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
    """Drive the plane with one number changed at a time: roll-outs and rows, value by value."""
    asked = config.scenario.but(lane_change=False)
    seeds, scenes = _points(config, asked)
    drawn = seeds >= 0
    seeds, scenes = seeds[drawn], Scenes({name: values[drawn] for name, values in scenes.numbers.items()})
    for varied, values in VARIED.items():
        for value in values:
            changed: dict[str, Any] = {varied: np.full(len(scenes), value)}
            cars = replace(scenes.cars(_gaps(scenes, asked), asked), **changed)
            paper = _paper(_codes(config, scenes, cars))
            yield (
                len(FORMS) * len(scenes),
                [
                    SensitivityRow(
                        cell=f"sensitivity/{varied}",
                        varied=varied,
                        value=value,
                        follower=asked.follower,
                        gap_behaviour=asked.gap,
                        seed=int(seed),
                        points=int((seeds == seed).sum()),
                        paper=int(paper[seeds == seed].sum()),
                    )
                    for seed in np.unique(seeds)
                ],
            )


def _points(config: CcrbConfig, asked: CcrbOptions) -> tuple[NDArray[np.int64], Scenes]:
    """Return drawn points and whose seed's they are; the last is the operating point, of seed -1."""
    from scipy.stats import qmc

    seeds = range(config.seed, config.seed + config.seeds)
    draws = [qmc.Sobol(2, rng=generator(seed, "ccrb", "plane")).random(config.seed_points) for seed in seeds]
    board, point = config.timeline.boards[0], np.zeros((1, 2))
    scenes = spread(
        asked,
        config.phase_rates,
        config.phase_gaps_m,
        np.concatenate([*draws, point]),
        prompt_s=board.prompt_s,
        tokens_per_skill=config.tokens_per_skill,
    )
    scenes.numbers["tokens_per_s"][-1] = board.tokens_per_s
    scenes.numbers["rear_gap_m"][-1] = asked.rear_gap_m
    return np.append(np.repeat(np.array(seeds), config.seed_points), -1), scenes


def _gaps(scenes: Scenes, asked: CcrbOptions) -> NDArray[np.str_]:
    return np.full(len(scenes), asked.gap)


def _codes(config: CcrbConfig, scenes: Scenes, cars: Cars) -> dict[str, NDArray[np.int64]]:
    """Drive the three policies: the code of each one's outcomes."""
    every = scenes.times(len(FORMS))
    numbers: dict[str, Any] = {
        name: np.tile(value, len(FORMS))
        for name in (each.name for each in fields(cars))
        if isinstance(value := getattr(cars, name), np.ndarray)
    }
    outcomes = drive_along(every, replace(cars, **numbers), schedules(config, scenes, list(FORMS)))
    return dict(zip(FORMS, np.split(outcomes.code, len(FORMS)), strict=True))


def _paper(codes: dict[str, NDArray[np.int64]]) -> NDArray[np.bool_]:
    """Return where the three outcomes are the paper's."""
    held: NDArray[np.bool_] = np.logical_and.reduce(
        [codes[policy] == OUTCOMES.index(outcome) for policy, outcome in PAPER.items()]
    )
    return held
