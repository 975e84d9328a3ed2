"""Plans of the driving scenario under every policy, driven, as rows of the tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final, TypeAlias

import numpy as np

from s2a_bench.act.record import executed
from s2a_bench.experiments.ccrb.loop import Looped
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES, RolloutRow, TrajectoryRow
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.rows import skill_rows, to_ns
from s2a_bench.policy import TOLERANCE_S, Plans, Policy, Schedule
from s2a_bench.policy.metrics import motion, stalls
from s2a_bench.scenario import EGO, ROLES, Simulator, open_simulator
from s2a_bench.scenario.ccrb.cars import TTC, ttc_aware
from s2a_bench.scenario.ccrb.drive import Driven, Trajectory, drive
from s2a_bench.scenario.ccrb.ego import PHASES
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.outcome import Outcomes
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.schema import Table

TableRows: TypeAlias = tuple[Table[Any], Iterable[Any]]
"""A table and rows for it."""
_OF_SCENARIO: Final = (
    *("follower", "reflex", "lane_change", "front_gap_m", "lead_decel_mps2", "rear_gap_m", "reaction_s"),
    "follower_survives",
)
"""Columns of a roll-out that a scenario has by their names."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """One plan in a scenario, and its schedule under every policy."""

    scenario: CcrbOptions
    setting: PlanSetting
    request_id: str
    plans: Plans
    policies: Mapping[str, Policy]
    schedules: Mapping[str, Schedule]
    late: bool | None = None
    """Whether the roll-out of s2a-ttc is late, if it is one of the policies."""

    def with_ttc(self) -> Prepared:
        schedule, (late,) = ttc_aware(self.plans, self.scenario.deadline_s)
        return replace(self, schedules={**self.schedules, TTC: schedule}, late=bool(late))


def complete(
    scenario: CcrbOptions, setting: PlanSetting, request_id: str, plans: Plans, policies: Mapping[str, Policy]
) -> Prepared:
    """Schedule a plan, drawn or received, under every policy."""
    if scenario.lane_change:
        changed: dict[str, Any] = {name: np.array(getattr(plans, name)) for name in ("nominal_s", "least_s", "most_s")}
        for name, value in changed.items():
            value[-1] = getattr(scenario.lane_durations, name)
        plans = replace(plans, **changed)
    schedules = {name: policy.schedule(plans) for name, policy in policies.items()}
    return Prepared(scenario, setting, request_id, plans, policies, schedules)


def point_rows(ready: Prepared, world: Simulator) -> Iterator[TableRows]:
    """Drive a plan under every policy, and yield the rows of each drive."""
    scenario = ready.scenario
    for name, schedule in ready.schedules.items():
        driven = drive(world, scenario.cars, scenario.driving, schedule, record=True)
        row = _rollout(ready, world.name, name, schedule, driven.outcomes)
        yield from _rows(ready, row, ready.plans, schedule, driven)


def loop_rows(ready: Prepared, world: Simulator, name: str, looped: Looped) -> Iterator[TableRows]:
    """Yield the rows of a closed loop, and of the roll-out on the arrivals of its plan, ``ready``."""
    scenario, (plans, schedule, _) = ready.scenario, executed(looped.record)
    row = _rollout(ready, world.name, name, schedule, looped.driven.outcomes)
    row = replace(row, real_time_factor=looped.real_time_factor, tracking_rms_mps=looped.tracking_rms_mps)
    yield from _rows(ready, row, plans, schedule, looped.driven)
    with closing(open_simulator("embedded" if scenario.lane_change else "longitudinal")) as exact:
        beside = drive(exact, scenario.cars, scenario.driving, ready.schedules[name])
        row = _rollout(ready, exact.name, name, ready.schedules[name], beside.outcomes)
        yield ROLLOUTS, [replace(row, study="rollout")]


def _rows(ready: Prepared, row: RolloutRow, plans: Plans, schedule: Schedule, driven: Driven) -> Iterator[TableRows]:
    path = driven.trajectory
    assert path is not None  # noqa: S101 - recorded
    texts = [[str(call) for call in ready.scenario.calls]]
    yield ROLLOUTS, [replace(row, **motion_of(path))]
    yield SKILLS, skill_rows(row.cell, plans, schedule, [ready.request_id], texts=texts)
    yield TRAJECTORIES, trajectory_rows(row.cell, path)


def _rollout(ready: Prepared, simulator: str, policy: str, schedule: Schedule, outcomes: Outcomes) -> RolloutRow:
    """Return the row of a drive at the operating point."""
    setting, scenario = ready.setting, ready.scenario
    (metrics,) = metrics_of_drives(schedule, outcomes)
    return RolloutRow(
        cell=f"{setting.name}/{scenario.gap}/{policy}",
        study="point",
        draw=0,
        policy=policy,
        simulator=simulator,
        gap_behaviour=scenario.gap,
        speed_mps=float(scenario.driving.set_point_mps[0, 0]),
        plan_decel_mps2=scenario.decel_mps2,
        **{name: value for name, value in asdict(setting).items() if name != "mode"},
        **{name: getattr(scenario, name) for name in _OF_SCENARIO},
        deadline_ns=to_ns(scenario.deadline_s),
        late=ready.late if policy == TTC else None,
        **metrics,
    )


def metrics_of_drives(schedule: Schedule, outcomes: Outcomes) -> Iterator[dict[str, Any]]:
    """Yield the metrics of each of M roll-outs, as columns of their rows; None for an undefined one."""
    stall_s = stalls(schedule)
    end_s = schedule.start_s[-1] + schedule.duration_s[-1]
    of_cars = {item.name: getattr(outcomes, item.name) for item in fields(outcomes) if item.name != "code"}
    of_cars["impact_speed_mps"] = outcomes.impact_speed_mps
    for place in range(len(outcomes.code)):
        values = {name: float(column[place]) for name, column in of_cars.items()}
        yield {
            "start_ns": to_ns(schedule.start_s[0, place]),
            "end_ns": to_ns(end_s[place]),
            "stalls": int((stall_s[:, place] > TOLERANCE_S).sum()),
            "stall_ns": to_ns(stall_s[:, place].sum()),
            "outcome": outcomes.name(place),
            **{name: value if math.isfinite(value) else None for name, value in values.items()},
        }


def motion_of(path: Trajectory) -> dict[str, Any]:
    """Return jerk and smoothness of the ego in a single roll-out, from the request to rest or impact."""
    speed = path.speed_mps[:, EGO, 0]
    if len(speed) < 3:  # noqa: PLR2004 - over at once
        return {}
    return motion(speed, float(path.time_s[1] - path.time_s[0]))


def trajectory_rows(cell: str, path: Trajectory) -> Iterator[TrajectoryRow]:
    columns = {
        f"{role}_{name}": getattr(path, name)[:, car, 0].tolist()
        for car, role in enumerate(ROLES)
        for name in ("position_m", "speed_mps", "acceleration_mps2")
    }
    for step, at_s in enumerate(path.time_s):
        yield TrajectoryRow(
            cell=cell,
            at_ns=to_ns(at_s),
            phase=PHASES[int(path.phase[step, 0])],
            skill=int(path.skill[step, 0]),
            ego_lateral_m=float(path.lateral_m[step, EGO, 0]),
            **{column: values[step] for column, values in columns.items()},
        )
