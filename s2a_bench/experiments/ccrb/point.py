"""The operating point: every policy drives the same plan, one after the other, and everything is kept."""

from __future__ import annotations

from typing import Any

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.plans import Prepared
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.to_rows import motion_of, rollout_rows, trajectory_rows
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.experiments.timeline.to_rows import skill_rows, to_ns
from s2a_bench.scenario import Simulator
from s2a_bench.scenario.ccrb.drive import drive
from s2a_bench.scenario.ccrb.ttc import NAME as TTC
from s2a_bench.store.run import RunWriter


def drive_point(config: CcrbConfig, ready: Prepared, world: Simulator, writer: RunWriter) -> None:
    """Drive the policies one after the other, and keep everything."""
    asked = config.scenario
    for name, schedule in ready.schedules.items():
        driven = drive(world, asked.cars, asked.driving, schedule, record=True)
        path = driven.trajectory
        assert path is not None  # noqa: S101 - as asked for
        cell = f"{ready.setting.name}/{asked.gap}/{name}"
        late = ready.late if name == TTC else None
        about = {**_about(config, ready, world), "cell": cell, "policy": name, "late": late}
        writer.append(ROLLOUTS, rollout_rows(about, schedule, driven.outcomes, motion=motion_of(path)))
        writer.append(SKILLS, skill_rows(cell, ready.plans, schedule, [ready.request_id], texts=[asked.texts]))
        writer.append(TRAJECTORIES, trajectory_rows(cell, path))


def _about(config: CcrbConfig, ready: Prepared, world: Simulator) -> dict[str, Any]:
    """Return what the roll-outs of the operating point have in common."""
    setting, asked = ready.setting, config.scenario
    return {
        "study": "point",
        "draw": 0,
        "board": setting.board,
        "title": setting.title,
        "emulated": setting.emulated,
        "simulator": world.name,
        "follower": asked.follower,
        "gap_behaviour": asked.gap,
        "reflex": asked.reflex,
        "lane_change": asked.lane_change,
        "tokens_per_s": setting.tokens_per_s,
        "prompt_s": setting.prompt_s,
        "tokens_per_skill": config.tokens_per_skill,
        "n_skills": setting.n_skills,
        "t_nom_s": setting.t_nom_s,
        "speed_mps": float(asked.driving.set_point_mps[0, 0]),
        "plan_decel_mps2": asked.decel_mps2,
        "front_gap_m": asked.front_gap_m,
        "lead_decel_mps2": asked.lead_decel_mps2,
        "rear_gap_m": asked.rear_gap_m,
        "reaction_s": asked.reaction_s,
        "follower_survives": asked.follower_survives,
        "deadline_ns": to_ns(asked.deadline_s),
    }
