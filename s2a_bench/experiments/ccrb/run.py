"""The CCRB run on modelled tokens: one plan, driven by every policy, and the studies of their ordering."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, Final

from s2a_bench.experiments.ccrb.config import CcrbClosedLoop, CcrbComputed, CcrbModelled
from s2a_bench.experiments.ccrb.drives import Prepared, complete, loop_rows, point_rows
from s2a_bench.experiments.ccrb.loop import replayed
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.studies import SCENES, drive_block
from s2a_bench.harness.timelines.cases import PlanCase
from s2a_bench.harness.timelines.policies import certain, draw
from s2a_bench.harness.timelines.rows import token_rows
from s2a_bench.machine import environment
from s2a_bench.policy import PlanShape
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins
from s2a_bench.scenario import open_simulator
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import Scenes, plane
from s2a_bench.scenario.ccrb.studies import draw as draw_scenes
from s2a_bench.stats.seeds import generator
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import RunWriter

_BOARD: Final = ("name", "title", "origin", "tokens_per_s", "prompt_s", "prompt_origin")


@dataclass(frozen=True, slots=True)
class CcrbPlan:
    """Drives on modelled tokens: as these come evenly, the plan is known beforehand."""

    ready: Prepared
    manifest: dict[str, Any]


def resolve(config: CcrbModelled) -> CcrbPlan:
    """Derive the run plan from a configuration; opens and starts nothing."""
    scenario, board = config.scenario, config.board
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "follower_law": scenario.follower_law,
        "boards": [{name: getattr(board, name) for name in _BOARD}],
        "provenance": Origins(board.provenance).to_manifest(),
    }
    case = PlanCase.of(board, PlanShape(scenario.skills, config.tokens_per_skill, scenario.durations, 0.0))
    _, plans = draw(case, config.seed, 1, "plans")
    policies = certain(config.named_policies, board)
    ready = complete(scenario, case.setting, case.setting.request_id(0), plans, policies)
    return CcrbPlan(ready, manifest)


def studies(config: CcrbComputed) -> Iterator[tuple[str, Scenes]]:
    """Yield the studies beside the operating point, with their scenarios."""
    if config.phase:
        yield (
            "phase",
            plane(
                config.scenario,
                config.phase_rates,
                config.phase_gaps_m,
                config.phase_points,
                prompt_s=config.board.prompt_s,
                tokens_per_skill=config.tokens_per_skill,
            ),
        )
    if config.random:
        yield "random", draw_scenes(generator(config.seed, "ccrb", "random"), config.random)


def run_ccrb(config: CcrbComputed, output: Path, progress: Progress) -> Path:
    plan, every = resolve(config), [*studies(config)]
    with closing(open_simulator(config.simulator)) as world, _create(plan, output, progress) as writer:
        for table, rows in point_rows(plan.ready.with_ttc() if config.ttc else plan.ready, world):
            writer.append(table, rows)
        _drive_studies(plan.ready.scenario, every, writer, progress)
        return writer.path


def run_closed_loop(config: CcrbClosedLoop, output: Path, progress: Progress) -> Path:
    plan = resolve(config)
    ready = plan.ready
    with closing(open_simulator(config.simulator)) as world, _create(plan, output, progress) as writer:
        writer.update(step_s=world.step_s)
        for name, policy in ready.policies.items():
            looped = replayed(ready.scenario, world, policy, ready.plans)
            for table, rows in loop_rows(ready, world, name, looped):
                writer.append(table, rows)
        return writer.path


def _create(plan: CcrbPlan, output: Path, progress: Progress) -> RunWriter:
    """Create the run folder, with the tokens of the plan."""
    ready, tokens_s = plan.ready, plan.ready.plans.token_s
    assert tokens_s is not None  # noqa: S101 - drawn plans have tokens
    writer = RunWriter.create(output, "ccrb", plan.manifest, (ROLLOUTS, TRAJECTORIES, SKILLS, TOKENS))
    progress.opened(writer.path)
    progress.stage("driving the operating point")
    writer.append(TOKENS, token_rows(ready.setting.name, tokens_s, [ready.request_id]))
    return writer


def _drive_studies(
    scenario: CcrbOptions, every: Sequence[tuple[str, Scenes]], writer: RunWriter, progress: Progress
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
