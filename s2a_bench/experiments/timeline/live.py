"""Live timelines: a model writes plans, over a real transport, and every policy executes them as they arrive.

Tokens, parsing and execution are real. With ``--pace`` the server delays the tokens to a rate, which is labelled as
set; only the replay of a profile is emulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from s2a_bench.act import SkillKind, SkillRobot, kind
from s2a_bench.act.events import PlanFeed, StreamBroke
from s2a_bench.act.record import Record
from s2a_bench.clock import now_ns, quick_switching
from s2a_bench.errors import S2AError
from s2a_bench.experiments.timeline.config import TimelineLive
from s2a_bench.experiments.timeline.execution import SideBySide, jitter_facts, keep
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.watch import Scene
from s2a_bench.frames.stamp import Stamped
from s2a_bench.harness.plan import RunPlan
from s2a_bench.harness.rounds import RunningLaunch, Task, run_requests
from s2a_bench.harness.timelines.cases import LearningPlan
from s2a_bench.harness.timelines.link import ModelRequests, PlanPrompt, PromptPlan, plan_requests
from s2a_bench.harness.timelines.policies import Following, prepare
from s2a_bench.plan import Parser, SkillSet
from s2a_bench.progress import Progress, watching
from s2a_bench.store.requests import SKILLS


@dataclass(frozen=True, slots=True)
class LivePlan:
    requests: RunPlan
    prompts: Sequence[PlanPrompt]
    learning: LearningPlan
    robot: str
    skills: SkillSet


def resolve_live(config: TimelineLive, progress: Progress) -> LivePlan:
    """Derive the run plan from a configuration, with the model's files; raises S2AError."""
    plans = prompt_plan(config)
    requests, prompts = plan_requests(config.requests.but(seed=config.seed), plans, progress)
    engine = {"engine": requests.engine.to_manifest()}
    requests = requests.with_manifest(
        configuration={**requests.manifest["configuration"], **config.to_manifest(), **engine},
        seeds={"sampling": config.seed, "source": config.seed, "nonce": requests.feed.nonce},
    )
    learning = LearningPlan(config.named_policies, config.seed, config.epsilon, config.track)
    return LivePlan(requests, prompts, learning, config.robot, config.skill_set)


def prompt_plan(config: TimelineLive) -> PromptPlan:
    skills = config.skill_set
    prompts = [
        replace(skills, skills=tuple(replace(each, durations=config.lasting(t_nom_s)) for each in skills.skills))
        for t_nom_s in config.t_nom_s
    ]
    return PromptPlan(prompts or [skills], config.tokens_per_skill, config.n_skills, config.task, not config.no_grammar)


def run_live(config: TimelineLive, output: Path, progress: Progress) -> Path:
    """Request plans, execute them, and return the run folder; raises S2AError.

    The folder keeps the timelines so far; the robots hold before KeyboardInterrupt passes through.
    """
    plan = resolve_live(config, progress)
    robot = kind(plan.robot, SkillKind)
    with ExitStack() as stack:  # first, as a model may take long to load
        robots = [stack.enter_context(closing(robot.open_skills(plan.skills))) for _ in plan.learning.policies]
        stack.enter_context(quick_switching())
        drive, tables = partial(_drive, plan, robots), (TIMELINES, SKILLS)
        task = Task("timeline", drive, tables=tables, source=lambda feed: Stamped(feed.open(), feed.nonce))
        return run_requests(task, plan.requests, output, progress)


def _drive(plan: LivePlan, robots: Sequence[SkillRobot], launch: RunningLaunch) -> None:
    model, records, progress = ModelRequests(launch, plan.prompts[0], plan.robot), list[Record](), launch.progress
    blocks = launch.plan.blocks
    progress.expect(blocks.warmup + len(plan.prompts) * blocks.requests)
    try:
        prior = model.warm_up()
        for ask in plan.prompts:
            following = prepare(plan.learning, ask.shape, prior)
            for number in range(blocks.requests):
                _execute(model, ask, number, following, robots, records)
                progress.advance()
        model.compare()
    finally:
        launch.writer.update(start_jitter=jitter_facts(records))


def _execute(
    model: ModelRequests,
    ask: PlanPrompt,
    plan: int,
    following: Following,
    robots: Sequence[SkillRobot],
    records: list[Record],
) -> None:
    """Request one plan, execute it under every policy as it arrives, and extend ``records``."""
    policies, progress = following.policies(), model.launch.progress
    skill_s = (ask.tokens_per_skill / model.rate if model.rate else 0.0) + ask.shape.expected.nominal_s
    span_s = ask.n_skills * skill_s
    progress.stage(f"{model.cell.name}, L = {ask.tokens_per_skill}: about {span_s:.0f} s")
    side_by_side = SideBySide(policies, ask.shape, ask.skills.gap, robots, model.launch.plan.timeout_s)
    feed = PlanFeed(Parser(ask.format), side_by_side.send)
    paced = [f"paced to {model.pace:g} tokens/s"] if model.pace else []
    remarks = [*paced, *(label for label in model.origin.labels if label != "paced")]
    title = ", ".join((f"live {model.cell.name}", f"L = {ask.tokens_per_skill}", *remarks))
    request_id = ""
    try:
        with side_by_side, watching(progress, Scene(title, side_by_side.records, ask.n_skills, span_s)):
            try:
                request_id = model.request(ask, plan, feed).sample.request_id
            except S2AError as error:  # the run ends after the current skills
                side_by_side.send(StreamBroke(now_ns(), "stream-error", f"{type(error).__name__}: {error}"))
                side_by_side.finish()
                raise
            side_by_side.finish()
    finally:  # also after an interruption
        executed = side_by_side.records
        records += executed
        model.learn_rate(max((record.token_ns for record in executed), key=len))
        model.launch.warnings.extend(keep(model.writer, model.setting(ask), plan, request_id, policies, executed))
    following.learn(side_by_side.records)
