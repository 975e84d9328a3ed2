"""The plan of a CCRB run: all that follows from its configuration, decided once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from s2a_bench.experiments.ccrb.config import CcrbComputed, CcrbModelled, CcrbRequested
from s2a_bench.harness.plan import RunPlan
from s2a_bench.harness.timelines.cases import LearningPlan, PlanCase, PlanSetting
from s2a_bench.harness.timelines.link import PlanPrompt, PromptPlan, plan_requests
from s2a_bench.harness.timelines.policies import certain, draw
from s2a_bench.machine import environment
from s2a_bench.plan import load_skills
from s2a_bench.policy import Plans, PlanShape, Policy, Schedule
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins
from s2a_bench.scenario import simulator_class
from s2a_bench.scenario.ccrb.cars import TTC, ttc_aware
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.scenario.ccrb.studies import Scenes, plane
from s2a_bench.scenario.ccrb.studies import draw as draw_scenes
from s2a_bench.stats.seeds import generator

_BOARD: Final = ("name", "title", "origin", "tokens_per_s", "prompt_s", "prompt_origin")


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


@dataclass(frozen=True, slots=True)
class CcrbPlan:
    """Drives on modelled tokens: as these come evenly, the plan is known beforehand."""

    ready: Prepared
    manifest: dict[str, Any]


@dataclass(frozen=True, slots=True)
class CcrbLivePlan:
    """Drives on a model's tokens."""

    scenario: CcrbOptions
    requests: RunPlan
    prompt: PlanPrompt
    shape: PlanShape
    learning: LearningPlan


def resolve(config: CcrbModelled) -> CcrbPlan:
    """Decide what follows from a configuration; opens and starts nothing."""
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
    policies = certain(config.chosen, board)
    ready = complete(scenario, case.setting, case.setting.request_id(0), plans, policies)
    return CcrbPlan(ready, manifest)


def studies(config: CcrbComputed) -> Iterator[tuple[str, Scenes]]:
    """Yield the studies beside the operating point, with their scenarios."""
    if config.phase:
        axes = config.phase_rates, config.phase_gaps_m, config.phase_points
        prompt_s, tokens = config.board.prompt_s, config.tokens_per_skill
        yield "phase", plane(config.scenario, *axes, prompt_s=prompt_s, tokens_per_skill=tokens)
    if config.random:
        yield "random", draw_scenes(generator(config.seed, "ccrb", "random"), config.random)


def resolve_live(config: CcrbRequested, progress: Progress) -> CcrbLivePlan:
    """Decide what follows from a configuration, with the model's files; raises S2AError."""
    scenario, tokens = config.scenario, config.tokens_per_skill
    prompts = PromptPlan([load_skills(config.skill_set)], [tokens], [scenario.skills])
    requests, (prompt,) = plan_requests(config.requests.but(seed=config.seed), prompts, progress)
    source = f"camera of {simulator_class(config.simulator).name}"
    requests = requests.with_manifest(
        configuration={**config.to_manifest(), "live": {**requests.manifest["configuration"], "source": source}},
        follower_law=scenario.follower_law,
        seeds={"sampling": config.seed, "nonce": requests.feed.nonce},
    )
    shape, learning = PlanShape(scenario.skills, tokens, scenario.durations), LearningPlan(config.chosen, config.seed)
    return CcrbLivePlan(scenario, requests, prompt, shape, learning)
