"""The CCRB run: one plan at the operating point, driven by every policy, and the studies of their ordering."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from s2a_bench.act.record import executed
from s2a_bench.experiments.ccrb.config import CcrbClosedLoop, CcrbComputed
from s2a_bench.experiments.ccrb.loop import Looped, replayed
from s2a_bench.experiments.ccrb.plan import CcrbPlan, resolve, studies
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.studies import SCENES, drive_block, motion_of, rollout_rows, trajectory_rows
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.harness.timelines.policies import draw, learn
from s2a_bench.harness.timelines.rows import skill_rows, to_ns, token_rows
from s2a_bench.policy import Plans, Policy, Schedule
from s2a_bench.scenario import Simulator, open_simulator
from s2a_bench.scenario.ccrb.drive import Driven, drive
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import Scenes
from s2a_bench.scenario.ccrb.ttc import NAME as TTC
from s2a_bench.scenario.ccrb.ttc import ttc_aware
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


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


def prepare(plan: CcrbPlan) -> Prepared:
    """Draw the board's tokens, which are the plans' ``token_s``, and schedule them under every policy."""
    setting, policies = plan.case.setting, learn(plan.case, plan.learning).made
    _, plans = draw(plan.case, plan.learning.seed, 1, "plans")
    return complete(plan.scenario, setting, setting.request_id(0), plans, policies)


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


def drive_point(ready: Prepared, world: Simulator, writer: RunWriter) -> None:
    scenario = ready.scenario
    for name, schedule in ready.schedules.items():
        driven = drive(world, scenario.cars, scenario.driving, schedule, record=True)
        _keep(ready, world, name, ready.plans, schedule, driven, writer)


def keep_loop(ready: Prepared, world: Simulator, name: str, looped: Looped, writer: RunWriter) -> None:
    """Write a closed loop, and beside it the roll-out on the arrivals of its plan, ``ready``."""
    scenario = ready.scenario
    plans, schedule, _ = executed(looped.record)
    writer.update(step_s=world.step_s)
    _keep(ready, world, name, plans, schedule, looped.driven, writer, looped.facts)
    with closing(open_simulator("embedded" if scenario.lane_change else "longitudinal")) as exact:
        beside = drive(exact, scenario.cars, scenario.driving, ready.schedules[name])
        about = {**_about(ready, exact, name), "study": "rollout"}
        writer.append(ROLLOUTS, rollout_rows(about, ready.schedules[name], beside.outcomes))


def _keep(
    ready: Prepared,
    world: Simulator,
    name: str,
    plans: Plans,
    schedule: Schedule,
    driven: Driven,
    writer: RunWriter,
    facts: Mapping[str, float | None] = MappingProxyType({}),
) -> None:
    path = driven.trajectory
    assert path is not None  # noqa: S101 - recorded
    about = {**_about(ready, world, name), **facts}
    texts = [[str(call) for call in ready.scenario.calls]]
    writer.append(ROLLOUTS, rollout_rows(about, schedule, driven.outcomes, motion=motion_of(path)))
    writer.append(SKILLS, skill_rows(about["cell"], plans, schedule, [ready.request_id], texts=texts))
    writer.append(TRAJECTORIES, trajectory_rows(about["cell"], path))


def _about(ready: Prepared, world: Simulator, name: str) -> dict[str, Any]:
    setting, scenario = ready.setting, ready.scenario
    of_setting = ("board", "title", "emulated", "tokens_per_s", "prompt_s", "tokens_per_skill", "n_skills", "t_nom_s")
    of_scenario = ("follower", "reflex", "lane_change", "front_gap_m", "lead_decel_mps2", "rear_gap_m", "reaction_s")
    return {
        "cell": f"{setting.name}/{scenario.gap}/{name}",
        "policy": name,
        "late": ready.late if name == TTC else None,
        "study": "point",
        "draw": 0,
        "simulator": world.name,
        "gap_behaviour": scenario.gap,
        "speed_mps": float(scenario.driving.set_point_mps[0, 0]),
        "plan_decel_mps2": scenario.decel_mps2,
        "follower_survives": scenario.follower_survives,
        "deadline_ns": to_ns(scenario.deadline_s),
        **{name: getattr(setting, name) for name in of_setting},
        **{name: getattr(scenario, name) for name in of_scenario},
    }


def run_ccrb(config: CcrbComputed, output: Path, progress: Progress) -> Path:
    plan = resolve(config)
    with closing(open_simulator(plan.simulator)) as world, _create(plan, output, progress) as writer:
        ready = _drawn(plan, writer)
        drive_point(ready.with_ttc() if config.ttc else ready, world, writer)
        _drive_studies(plan.scenario, studies(config), writer, progress)
        return writer.path


def run_closed_loop(config: CcrbClosedLoop, output: Path, progress: Progress) -> Path:
    plan = resolve(config)
    with closing(open_simulator(plan.simulator)) as world, _create(plan, output, progress) as writer:
        ready = _drawn(plan, writer)
        for name, policy in ready.policies.items():
            keep_loop(ready, world, name, replayed(plan.scenario, world, policy, ready.plans), writer)
        return writer.path


def _create(plan: CcrbPlan, output: Path, progress: Progress) -> RunWriter:
    writer = RunWriter.create(output, "ccrb", plan.manifest, (ROLLOUTS, TRAJECTORIES, SKILLS, TOKENS))
    progress.opened(writer.path)
    progress.stage("driving the operating point")
    return writer


def _drawn(plan: CcrbPlan, writer: RunWriter) -> Prepared:
    """Prepare a plan and write its tokens."""
    ready = prepare(plan)
    tokens_s = ready.plans.token_s
    assert tokens_s is not None  # noqa: S101 - drawn plans have tokens
    writer.append(TOKENS, token_rows(ready.setting.name, tokens_s, [ready.request_id]))
    return ready


def _drive_studies(
    scenario: CcrbOptions, every: Iterable[tuple[str, Scenes]], writer: RunWriter, progress: Progress
) -> None:
    blocks = [
        (study, scenes.cut(slice(first, first + SCENES)))
        for study, scenes in every
        for first in range(0, len(scenes), SCENES)
    ]
    if not blocks:
        return
    progress.stage("driving " + " and ".join(dict.fromkeys(study for study, _ in blocks)))
    progress.expect(len(blocks))
    driven, spent_s = 0, 0.0
    for study, scenes in blocks:
        before = process_time()
        count, rows = drive_block(scenario, study, scenes)
        spent_s += process_time() - before
        driven += count
        writer.append(ROLLOUTS, rows)
        progress.advance()
    writer.update(studies={"rollouts": driven, "rollouts_per_cpu_s": driven / spent_s})
