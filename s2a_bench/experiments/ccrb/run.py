"""The CCRB run on modelled tokens: one plan, driven by every policy, and the studies of their ordering."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING

from s2a_bench.experiments.ccrb.config import CcrbClosedLoop, CcrbComputed
from s2a_bench.experiments.ccrb.drives import loop_rows, point_rows
from s2a_bench.experiments.ccrb.loop import replayed
from s2a_bench.experiments.ccrb.plan import CcrbPlan, resolve, studies
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.studies import SCENES, drive_block
from s2a_bench.harness.timelines.rows import token_rows
from s2a_bench.scenario import open_simulator
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import Scenes
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


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
