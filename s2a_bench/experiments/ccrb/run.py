"""The CCRB run: one plan at the operating point, driven by every policy, and the studies of their ordering."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from s2a_bench.act.record import executed
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.loop import Looped, replayed
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.studies import SCENES, drive_block, motion_of, rollout_rows, studies, trajectory_rows
from s2a_bench.harness.timelines.config import PlanSetting, settings
from s2a_bench.harness.timelines.policies import draw, learn
from s2a_bench.harness.timelines.rows import skill_rows, to_ns, token_rows
from s2a_bench.machine import environment
from s2a_bench.policy import Plans, Policy, Schedule
from s2a_bench.provenance import Origins
from s2a_bench.scenario import Simulator, open_simulator
from s2a_bench.scenario.ccrb.cars import TTC, ttc_aware
from s2a_bench.scenario.ccrb.drive import Driven, drive
from s2a_bench.scenario.ros import with_ego
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


@dataclass(frozen=True, slots=True)
class Prepared:
    """One plan and its schedule under every policy."""

    setting: PlanSetting
    request_id: str
    plans: Plans
    policies: Mapping[str, Policy]
    schedules: dict[str, Schedule]
    late: bool | None


def prepare(config: CcrbConfig) -> Prepared:
    """Draw the board's tokens, which are the plans' ``token_s``, and schedule them under every policy."""
    board, setting = next(settings(config.timeline))
    known = learn(config.timeline, board, setting)
    _, plans = draw(config.timeline, board, setting, 1, "plans")
    policies = {name: known.prepare(policy) for name, policy in config.timeline.chosen.items()}
    return complete(config, setting, setting.request_id(0), plans, policies)


def complete(
    config: CcrbConfig, setting: PlanSetting, request_id: str, plans: Plans, policies: Mapping[str, Policy]
) -> Prepared:
    """Schedule a plan, drawn or received, under every policy."""
    scenario = config.scenario
    if scenario.lane_change:
        changed: dict[str, Any] = {name: np.array(getattr(plans, name)) for name in ("nominal_s", "least_s", "most_s")}
        for name, value in changed.items():
            value[-1] = getattr(scenario.lane_durations, name)
        plans = replace(plans, **changed)
    schedules = {name: policy.schedule(plans) for name, policy in policies.items()}
    late = None
    if config.ttc:
        schedules[TTC], (is_late,) = ttc_aware(plans, scenario.deadline_s)
        late = bool(is_late)
    return Prepared(setting, request_id, plans, policies, schedules, late)


def drive_point(config: CcrbConfig, ready: Prepared, world: Simulator, writer: RunWriter) -> None:
    scenario = config.scenario
    for name, schedule in ready.schedules.items():
        driven = drive(world, scenario.cars, scenario.driving, schedule, record=True)
        _keep(config, ready, world, name, ready.plans, schedule, driven, writer)


def keep_loop(
    config: CcrbConfig, ready: Prepared, world: Simulator, name: str, looped: Looped, writer: RunWriter
) -> None:
    """Write a closed loop, and beside it the roll-out on the arrivals of its plan, ``ready``."""
    scenario = config.scenario
    plans, schedule, _ = executed(looped.record)
    writer.update(step_s=world.step_s)
    _keep(config, ready, world, name, plans, schedule, looped.driven, writer, looped.facts)
    with closing(open_simulator("embedded" if scenario.lane_change else "longitudinal")) as exact:
        beside = drive(exact, scenario.cars, scenario.driving, ready.schedules[name])
        about = {**_about(config, ready, exact, name), "study": "rollout"}
        writer.append(ROLLOUTS, rollout_rows(about, ready.schedules[name], beside.outcomes))


def _keep(
    config: CcrbConfig,
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
    about = {**_about(config, ready, world, name), **facts}
    texts = [[str(call) for call in config.scenario.calls]]
    writer.append(ROLLOUTS, rollout_rows(about, schedule, driven.outcomes, motion=motion_of(path)))
    writer.append(SKILLS, skill_rows(about["cell"], plans, schedule, [ready.request_id], texts=texts))
    writer.append(TRAJECTORIES, trajectory_rows(about["cell"], path))


def _about(config: CcrbConfig, ready: Prepared, world: Simulator, name: str) -> dict[str, Any]:
    setting, scenario = ready.setting, config.scenario
    of_setting = ("board", "title", "emulated", "tokens_per_s", "prompt_s", "n_skills", "t_nom_s")
    of_scenario = ("follower", "reflex", "lane_change", "front_gap_m", "lead_decel_mps2", "rear_gap_m", "reaction_s")
    return {
        "cell": f"{setting.name}/{scenario.gap}/{name}",
        "policy": name,
        "late": ready.late if name == TTC else None,
        "study": "point",
        "draw": 0,
        "simulator": world.name,
        "gap_behaviour": scenario.gap,
        "tokens_per_skill": config.tokens_per_skill,
        "speed_mps": float(scenario.driving.set_point_mps[0, 0]),
        "plan_decel_mps2": scenario.decel_mps2,
        "follower_survives": scenario.follower_survives,
        "deadline_ns": to_ns(scenario.deadline_s),
        **{name: getattr(setting, name) for name in of_setting},
        **{name: getattr(scenario, name) for name in of_scenario},
    }


_BOARD = ("name", "title", "origin", "tokens_per_s", "prompt_s", "prompt_origin")


def run_ccrb(config: CcrbConfig, output: Path, progress: Progress) -> Path:
    with closing(open_simulator(config.simulator)) as bare, closing(with_ego(bare, config.ego)) as world:
        if not config.plan_request.live:
            return _run_modelled(config, world, output, progress)
        from s2a_bench.experiments.ccrb.live import run_ccrb_live

        return run_ccrb_live(config, world, output, progress)


def _run_modelled(config: CcrbConfig, world: Simulator, output: Path, progress: Progress) -> Path:
    board, ready = config.timeline.boards[0], prepare(config)
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "follower_law": config.scenario.follower_law,
        "boards": [{name: getattr(board, name) for name in _BOARD}],
        "provenance": Origins(board.provenance).to_manifest(),
    }
    with RunWriter.create(output, "ccrb", manifest, (ROLLOUTS, TRAJECTORIES, SKILLS, TOKENS)) as writer:
        progress.opened(writer.path)
        progress.stage("driving the operating point")
        tokens_s = ready.plans.token_s
        assert tokens_s is not None  # noqa: S101 - drawn plans have tokens
        writer.append(TOKENS, token_rows(ready.setting.name, tokens_s, [ready.request_id]))
        if not config.closed_loop:
            drive_point(config, ready, world, writer)
        for name, policy in ready.policies.items() if config.closed_loop else ():
            keep_loop(config, ready, world, name, replayed(config.scenario, world, policy, ready.plans), writer)
        _drive_studies(config, writer, progress)
        return writer.path


def _drive_studies(config: CcrbConfig, writer: RunWriter, progress: Progress) -> None:
    blocks = [
        (study, scenes.cut(slice(first, first + SCENES)))
        for study, scenes in studies(config)
        for first in range(0, len(scenes), SCENES)
    ]
    if not blocks:
        return
    progress.stage("driving " + " and ".join(dict.fromkeys(study for study, _ in blocks)))
    progress.expect(len(blocks))
    driven, spent_s = 0, 0.0
    for study, scenes in blocks:
        before = process_time()
        count, rows = drive_block(config, study, scenes)
        spent_s += process_time() - before
        driven += count
        writer.append(ROLLOUTS, rows)
        progress.advance()
    writer.update(studies={"rollouts": driven, "rollouts_per_cpu_s": driven / spent_s})
