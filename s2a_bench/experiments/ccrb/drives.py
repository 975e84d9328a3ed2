"""Plans of the driving scenario under every policy, driven, as rows of the tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np

from s2a_bench.act.record import executed
from s2a_bench.experiments.ccrb.loop import Looped
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES, RolloutRow, TrajectoryRow
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.rows import skill_rows, to_ns
from s2a_bench.policy import TOLERANCE_S, Plans, Policy, Schedule
from s2a_bench.policy.metrics import peak_jerk, rms_jerk, sparc, stalls
from s2a_bench.scenario import EGO, ROLES, Simulator, open_simulator
from s2a_bench.scenario.ccrb.cars import TTC, ttc_aware
from s2a_bench.scenario.ccrb.drive import Driven, Trajectory, drive
from s2a_bench.scenario.ccrb.ego import PHASES
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.outcome import Outcomes
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.schema import Table

OF_CARS: Final = (
    *("impact_speed_mps", "front_impact_mps", "rear_impact_mps", "min_front_gap_m", "min_rear_gap_m"),
    *("min_front_ttc_s", "min_rear_ttc_s", "required_decel_mps2"),
)
"""The metrics that `Outcomes` have."""
TableRows: TypeAlias = tuple[Table[Any], Iterable[Any]]
"""A table and rows for it."""


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
    """Of s2a-ttc, if it is one of them."""

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
        yield from _rows(ready, _about(ready, world.name, name), ready.plans, schedule, driven)


def loop_rows(ready: Prepared, world: Simulator, name: str, looped: Looped) -> Iterator[TableRows]:
    """Yield the rows of a closed loop, and of the roll-out on the arrivals of its plan, ``ready``."""
    scenario, (plans, schedule, _) = ready.scenario, executed(looped.record)
    yield from _rows(ready, {**_about(ready, world.name, name), **looped.facts}, plans, schedule, looped.driven)
    with closing(open_simulator("embedded" if scenario.lane_change else "longitudinal")) as exact:
        beside = drive(exact, scenario.cars, scenario.driving, ready.schedules[name])
        about = {**_about(ready, exact.name, name), "study": "rollout"}
        yield ROLLOUTS, rollout_rows(about, ready.schedules[name], beside.outcomes)


def _rows(
    ready: Prepared, about: Mapping[str, Any], plans: Plans, schedule: Schedule, driven: Driven
) -> Iterator[TableRows]:
    path, cell = driven.trajectory, about["cell"]
    assert path is not None  # noqa: S101 - recorded
    texts = [[str(call) for call in ready.scenario.calls]]
    yield ROLLOUTS, rollout_rows(about, schedule, driven.outcomes, motion=motion_of(path))
    yield SKILLS, skill_rows(cell, plans, schedule, [ready.request_id], texts=texts)
    yield TRAJECTORIES, trajectory_rows(cell, path)


def _about(ready: Prepared, simulator: str, name: str) -> dict[str, Any]:
    setting, scenario = ready.setting, ready.scenario
    of_setting = ("board", "title", "emulated", "tokens_per_s", "prompt_s", "tokens_per_skill", "n_skills", "t_nom_s")
    of_scenario = ("follower", "reflex", "lane_change", "front_gap_m", "lead_decel_mps2", "rear_gap_m", "reaction_s")
    return {
        "cell": f"{setting.name}/{scenario.gap}/{name}",
        "policy": name,
        "late": ready.late if name == TTC else None,
        "study": "point",
        "draw": 0,
        "simulator": simulator,
        "gap_behaviour": scenario.gap,
        "speed_mps": float(scenario.driving.set_point_mps[0, 0]),
        "plan_decel_mps2": scenario.decel_mps2,
        "follower_survives": scenario.follower_survives,
        "deadline_ns": to_ns(scenario.deadline_s),
        **{name: getattr(setting, name) for name in of_setting},
        **{name: getattr(scenario, name) for name in of_scenario},
    }


def rollout_rows(
    about: Mapping[str, Any], schedule: Schedule, outcomes: Outcomes, *, motion: Mapping[str, Any] | None = None
) -> Iterator[RolloutRow]:
    """Yield the rows of M roll-outs; a value of ``about`` is common to all, or an array of M."""
    stall_s = stalls(schedule)
    end_s = schedule.start_s[-1] + schedule.duration_s[-1]
    shared = {name: value for name, value in about.items() if not isinstance(value, np.ndarray)}
    each = {name: value for name, value in about.items() if isinstance(value, np.ndarray)}
    found = {name: getattr(outcomes, name) for name in OF_CARS}
    for place in range(len(outcomes.code)):
        metrics: dict[str, Any] = {name: float(values[place]) for name, values in found.items()}
        yield RolloutRow(
            **shared,
            **{name: value[place].item() for name, value in each.items()},
            start_ns=to_ns(schedule.start_s[0, place]),
            end_ns=to_ns(end_s[place]),
            stalls=int((stall_s[:, place] > TOLERANCE_S).sum()),
            stall_ns=to_ns(stall_s[:, place].sum()),
            outcome=outcomes.name(place),
            **{name: value if math.isfinite(value) else None for name, value in metrics.items()},
            **(motion or {}),
        )


def motion_of(path: Trajectory) -> dict[str, float]:
    """Return jerk and smoothness of the ego in a single roll-out, from the request to rest or impact."""
    speed = path.speed_mps[:, EGO, 0]
    if len(speed) < 3:  # noqa: PLR2004 - over at once
        return {}
    step_s = float(path.time_s[1] - path.time_s[0])
    return {"rms_jerk": rms_jerk(speed, step_s), "peak_jerk": peak_jerk(speed, step_s), "sparc": sparc(speed, step_s)}


def trajectory_rows(cell: str, path: Trajectory) -> Iterator[TrajectoryRow]:
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
