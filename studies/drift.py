"""What happens when the machine drifts away from its calibration, and what tracking lambda makes of it.

Plans follow one another: the machine keeps its speed for a quarter of them, then it drifts. Three ways to go on:
*fixed* keeps prior and lambda; *tracked* follows lambda (`conformal.Tracker`); *refitted* also takes the prior from
the last plans, anew every 50 plans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.policy import Plans
from s2a_bench.policy.conformal import ANY_STALL_S, TrackedPolicy, Tracker, choose, scores, take
from s2a_bench.policy.estimator import GapPrior
from s2a_bench.policy.metrics import PlanMetrics, measure
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.stats.seeds import generator
from studies.config import Cell, StudyConfig
from studies.rows import StudyRow, row_of
from studies.worlds import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats

PLANS: Final = 4000
BLOCKS: Final = 8
REFIT: Final = 50
ARMS: Final = ("fixed", "tracked", "refitted")
WORLDS: Final = (World(4.8, 0.5, 6, 8, 1.0), World(0.58, 3.0, 1, 8, 1.0))


def drifts(plans: int) -> dict[str, Floats]:
    """Return by how much gaps are stretched, plan by plan, for each kind of drift."""
    place = np.arange(plans) / plans
    return {
        "none": np.ones(plans),
        "step x 1.3": np.where(place < 1 / 4, 1.0, 1.3),
        "ramp to x 2": np.interp(place, [1 / 4, 3 / 4], [1.0, 2.0]),
        "step x 0.7": np.where(place < 1 / 4, 1.0, 0.7),
    }


def cells(config: StudyConfig) -> Sequence[Cell]:
    """List worlds and drifts."""
    return [partial(cell, config, world, name) for world in WORLDS for name in drifts(1)]


def cell(config: StudyConfig, world: World, drift: str) -> list[StudyRow]:
    """Follow one sequence of plans in each of the three ways."""
    rng = generator(config.seed, config.name, world.key, drift)
    count = config.plans or PLANS
    calibration = world.draw(rng, config.calibration_plans)
    plans = world.draw(rng, count, drifts(count)[drift])
    rows = []
    for arm in ARMS:
        caution, found = follow(calibration, plans, config.epsilon, arm)
        for block, places in enumerate(np.array_split(np.arange(count), BLOCKS)):
            rows.append(
                row_of(
                    config.name,
                    world,
                    StreamToAct.name,
                    _at(found, places),
                    caution=float(np.median(caution[places])),
                    calibration_plans=config.calibration_plans,
                    condition=f"{drift}, {arm}",
                    block=block,
                )
            )
    return rows


def follow(calibration: Plans, plans: Plans, epsilon: float, arm: str) -> tuple[Floats, PlanMetrics]:
    """Decide the plans one after another; returns each plan's lambda and how it went."""
    assert calibration.token_s is not None  # noqa: S101 - worlds draw tokens
    policy = StreamToAct(GapPrior.fit(calibration.token_s))
    score, count = scores(policy, calibration), plans.arrival_s.shape[1]
    if arm == "fixed":
        fixed = choose(score, epsilon).caution
        schedule = replace(policy, caution=fixed).schedule(plans)
        return np.full(count, fixed), measure(plans, schedule, tolerance_s=ANY_STALL_S)
    tracked = TrackedPolicy(policy, Tracker(score, epsilon))
    window, seen = calibration.arrival_s.shape[1], calibration.token_s
    chosen, parts = [], []
    for places in np.array_split(np.arange(count), max(1, count // REFIT) if arm == "refitted" else 1):
        part = take(plans, places)
        caution, schedule = tracked.follow(part)
        chosen.append(caution)
        parts.append(measure(part, schedule, tolerance_s=ANY_STALL_S))
        if arm == "refitted":
            assert part.token_s is not None  # noqa: S101
            seen = np.concatenate([seen, part.token_s], axis=1)[:, -window:]
            tracked = TrackedPolicy(StreamToAct(GapPrior.fit(seen)), tracked.tracker)
    columns = [[getattr(part, item.name) for part in parts] for item in fields(PlanMetrics)]
    return np.concatenate(chosen), PlanMetrics(*map(np.concatenate, columns))


def _at(found: PlanMetrics, places: NDArray[np.intp]) -> PlanMetrics:
    return PlanMetrics(*(getattr(found, item.name)[places] for item in fields(PlanMetrics)))
