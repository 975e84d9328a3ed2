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
from s2a_bench.plan.skillset import Durations
from s2a_bench.policy import Plans, Policy, Schedule
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


def prepare(config: CcrbConfig) -> Prepared:
    """Let the board's tokens come, and ask the policies; they are the plans' ``token_s``."""
    board, setting = next(settings(config.timeline))
    known = learn(config.timeline, board, setting)
    _, plans = draw(config.timeline, board, setting, 1, "plans")
    policies = {name: known.prepare(policy) for name, policy in config.timeline.chosen.items()}
    return complete(config, setting, setting.request_id(0), plans, policies)


def complete(
    config: CcrbConfig, setting: Setting, request_id: str, plans: Plans, policies: Mapping[str, Policy]
) -> Prepared:
    """Ask the policies about a plan, drawn or heard."""
    asked = config.scenario
    if asked.lane_change:
        plans = with_lane_change(plans, asked.lane_durations)
    schedules = {name: policy.schedule(plans) for name, policy in policies.items()}
    late = None
    if config.ttc:
        timed = ttc_aware(plans, asked.deadline_s)
        schedules[TTC], late = timed.schedule, bool(timed.late[0])
    return Prepared(setting, request_id, plans, schedules, late)


def with_lane_change(plans: Plans, lane: Durations) -> Plans:
    """Let the last skill take as long as a lane change."""
    rows = {"nominal_s": lane.nominal_s, "least_s": lane.least_s, "most_s": lane.most_s}
    changed: dict[str, Any] = {name: np.array(getattr(plans, name)) for name in rows}
    for name, value in rows.items():
        changed[name][-1] = value
    return replace(plans, **changed)
