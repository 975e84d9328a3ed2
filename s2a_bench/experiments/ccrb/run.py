"""The CCRB run: the policies at one operating point, and where their ordering holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.plans import Prepared, prepare, skill_texts
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.studies import Scenes, phase_scenes, pieces, random_scenes, study_rows
from s2a_bench.experiments.ccrb.to_rows import motion_of, rollout_rows, trajectory_rows
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.experiments.timeline.to_rows import skill_rows, to_ns, token_rows
from s2a_bench.machine import environment
from s2a_bench.scenario import Simulator, simulator
from s2a_bench.scenario.ccrb.drive import drive
from s2a_bench.scenario.ccrb.ttc import NAME as TTC
from s2a_bench.store.requests import TOKENS
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


def run_ccrb(config: CcrbConfig, output: Path, progress: Progress, **settings: object) -> Path:
    """Drive all roll-outs and return the run folder; ``settings`` go to the simulator. Raises S2AError."""
    config.check()
    world = simulator(config.simulator, **settings)
    try:
        board = config.timeline.boards[0]
        manifest = {
            "configuration": {**asdict(config), "t_nom_s": config.durations.nominal_s, "time": "virtual"},
            "environment": environment.collect(),
            "seeds": {"plans": config.seed},
            "boards": [
                {
                    "name": board.name,
                    "title": board.title,
                    "origin": board.origin,
                    "tokens_per_s": board.tokens_per_s,
                    "prompt_s": board.prompt_s,
                    "prompt_origin": board.prompt_origin,
                }
            ],
        }
        with RunWriter.create(output, "ccrb", manifest, (ROLLOUTS, TRAJECTORIES, SKILLS, TOKENS)) as writer:
            progress.opened(writer.path)
            progress.stage("driving the operating point")
            ready = prepare(config)
            tokens_s = ready.plans.token_s
            assert tokens_s is not None  # noqa: S101 - drawn plans have tokens
            writer.append(TOKENS, token_rows(ready.setting.name, tokens_s, [ready.request_id]))
            drive_point(config, ready, world, writer)
            _drive_studies(config, writer, progress)
            return writer.path
    finally:
        world.close()


def drive_point(config: CcrbConfig, ready: Prepared, world: Simulator, writer: RunWriter) -> None:
    """Drive the policies one after the other, and keep everything."""
    setting = ready.setting
    for name, schedule in ready.schedules.items():
        driven = drive(world, config.cars, ready.driving, schedule, record=True)
        path = driven.trajectory
        assert path is not None  # noqa: S101 - as asked for
        cell = f"{setting.name}/{config.gap}/{name}"
        about = {
            **_about(config, ready, world),
            "cell": cell,
            "policy": name,
            "late": ready.late if name == TTC else None,
        }
        writer.append(ROLLOUTS, rollout_rows(about, schedule, driven.outcomes, motion=motion_of(path)))
        texts = [skill_texts(ready.driving)]
        writer.append(SKILLS, skill_rows(cell, ready.plans, schedule, [ready.request_id], texts=texts))
        writer.append(TRAJECTORIES, trajectory_rows(cell, path))


def _drive_studies(config: CcrbConfig, writer: RunWriter, progress: Progress) -> None:
    """Drive phase diagram and random scenarios, and say how fast that went."""
    work = list(_studies(config))
    if not work:
        return
    progress.stage("driving " + " and ".join(dict.fromkeys(study for study, _ in work)))
    progress.expect(sum(pieces(scenes) for _, scenes in work))
    driven, spent_s = 0, 0.0
    for study, scenes in work:
        rows_of = study_rows(config, study, scenes)
        while True:
            before = process_time()
            piece = next(rows_of, None)
            spent_s += process_time() - before
            if piece is None:
                break
            driven += piece[0]
            writer.append(ROLLOUTS, piece[1])
            progress.advance()
    writer.update(studies={"rollouts": driven, "rollouts_per_cpu_s": driven / spent_s})


def _studies(config: CcrbConfig) -> Iterator[tuple[str, Scenes]]:
    """List what is to be driven besides the operating point."""
    if config.phase:
        yield "phase", phase_scenes(config)
    if config.random:
        yield "random", random_scenes(config)


def _about(config: CcrbConfig, ready: Prepared, world: Simulator) -> dict[str, Any]:
    """Return what the roll-outs of the operating point have in common."""
    setting = ready.setting
    return {
        "study": "point",
        "draw": 0,
        "board": setting.board,
        "title": setting.title,
        "emulated": setting.emulated,
        "simulator": world.name,
        "follower": config.follower,
        "gap_behaviour": config.gap,
        "reflex": config.reflex,
        "lane_change": config.lane_change,
        "tokens_per_s": setting.tokens_per_s,
        "prompt_s": setting.prompt_s,
        "tokens_per_skill": config.tokens_per_skill,
        "n_skills": setting.n_skills,
        "t_nom_s": setting.t_nom_s,
        "speed_mps": float(ready.driving.set_point_mps[0, 0]),
        "plan_decel_mps2": ready.decel_mps2,
        "front_gap_m": config.front_gap_m,
        "lead_decel_mps2": config.lead_decel_mps2,
        "rear_gap_m": config.rear_gap_m,
        "reaction_s": config.reaction_s,
        "deadline_ns": to_ns(ready.deadline_s),
    }
