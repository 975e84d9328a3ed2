"""The plans of a CCRB run: tokens of a board, skills of the driving set, and when each policy runs them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.timeline.config import settings
from s2a_bench.experiments.timeline.policies import draw, learn
from s2a_bench.experiments.timeline.to_rows import Setting
from s2a_bench.policy import Plans, Policy, Schedule
from s2a_bench.scenario.ccrb.cars import KMH, DrivingPlan, braking_plan, plan_decel, start_deadline
from s2a_bench.scenario.ccrb.ttc import NAME as TTC
from s2a_bench.scenario.ccrb.ttc import ttc_aware


@dataclass(frozen=True, slots=True)
class Prepared:
    """One plan, ready to be driven by every policy."""

    setting: Setting
    request_id: str
    plans: Plans
    schedules: dict[str, Schedule]
    late: bool | None
    """Whether s2a-ttc missed its deadline; None where it was not asked for."""
    driving: DrivingPlan
    decel_mps2: float
    deadline_s: float


def prepare(config: CcrbConfig) -> Prepared:
    """Let the board's tokens come, and ask the policies; they are the plans' ``token_s``."""
    board, setting = next(settings(config.timeline))
    known = learn(config.timeline, board, setting)
    _, plans = draw(config.timeline, board, setting, 1, "plans")
    policies = {name: known.prepare(name) for name in config.policies}
    return complete(config, setting, setting.request_id(0), plans, policies)


def complete(
    config: CcrbConfig, setting: Setting, request_id: str, plans: Plans, policies: Mapping[str, Policy]
) -> Prepared:
    """Ask the policies about a plan, drawn or heard, and lay out what is driven."""
    if config.lane_change:
        plans = with_lane_change(plans, config)
    schedules = {name: policy.schedule(plans) for name, policy in policies.items()}
    decel = float(plan_decel(config.cars, config.n_skills, config.durations.nominal_s, lane_change=config.lane_change))
    if config.plan_decel_mps2 is not None:
        decel = config.plan_decel_mps2
    deadline_s = float(start_deadline(config.cars, decel))
    late = None
    if config.ttc:
        timed = ttc_aware(plans, deadline_s)
        schedules[TTC], late = timed.schedule, bool(timed.late[0])
    driving = braking_plan(
        config.cars, config.n_skills, config.durations.nominal_s, decel_mps2=decel, lane_change=config.lane_change
    )
    return Prepared(setting, request_id, plans, schedules, late, driving, decel, deadline_s)


def with_lane_change(plans: Plans, config: CcrbConfig) -> Plans:
    """Let the last skill take as long as a lane change."""
    lane = config.lane_durations
    rows = {"nominal_s": lane.nominal_s, "least_s": lane.least_s, "most_s": lane.most_s}
    changed: dict[str, Any] = {name: np.array(getattr(plans, name)) for name in rows}
    for name, value in rows.items():
        changed[name][-1] = value
    return replace(plans, **changed)


def skill_texts(driving: DrivingPlan) -> list[str]:
    """Write the plan's calls as the driving skill set does."""
    points = driving.set_point_mps[1:, 0] / KMH
    return [
        "change_lane(left)" if lane else f"set_speed({round(float(kmh), 1):g})"
        for kmh, lane in zip(points, driving.lane, strict=True)
    ]
