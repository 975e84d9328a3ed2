"""The plan of a timeline run: all that follows from its configuration, decided once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.boards.gaps import to_table
from s2a_bench.boards.tokens import Board
from s2a_bench.errors import UsageError
from s2a_bench.experiments.timeline.config import TimelineComputed, TimelineLive
from s2a_bench.harness.plan import RunPlan
from s2a_bench.harness.timelines.cases import LearningPlan, PlanCase
from s2a_bench.harness.timelines.link import PlanPrompt, PromptPlan, plan_requests
from s2a_bench.harness.timelines.policies import plans_of
from s2a_bench.machine import environment
from s2a_bench.plan import SkillSet
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import read_run
from s2a_bench.types import Timing

if TYPE_CHECKING:
    from s2a_bench.policy import Floats


@dataclass(frozen=True, slots=True)
class ModelledPlan:
    """A run of timelines on modelled tokens, computed or played."""

    cases: Sequence[PlanCase]
    plans: int
    """Plans of a case."""
    learning: LearningPlan
    manifest: dict[str, Any]


@dataclass(frozen=True, slots=True)
class LivePlan:
    """A run of timelines on a model's plans."""

    requests: RunPlan
    prompts: Sequence[PlanPrompt]
    learning: LearningPlan
    robot: str
    skills: SkillSet


def resolve(config: TimelineComputed) -> ModelledPlan:
    """Decide what follows from a configuration; raises S2AError for recorded answers that are missing or too short."""
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "boards": [_facts(board) for board in config.boards],
        "provenance": _origins(config).to_manifest(),
    }
    learning = LearningPlan(
        policies=config.chosen,
        seed=config.seed,
        epsilon=config.epsilon,
        track=config.track,
        random=config.random,
        calibration_plans=config.calibration_plans,
        guarantee=config.guarantee,
        answers=recordings(config.calibrate) if config.calibrate else (),
    )
    for case in config.cases if learning.answers else ():
        plans_of(case, learning)  # refuse before the folder is created
    return ModelledPlan(config.cases, config.plans_a_cell, learning, manifest)


def resolve_live(config: TimelineLive, progress: Progress) -> LivePlan:
    """Decide what follows from a configuration, with the model's files; raises S2AError."""
    plans = prompt_plan(config)
    requests, prompts = plan_requests(config.requests.but(seed=config.seed), plans, progress)
    engine = {"engine": requests.engine.to_manifest()}
    requests = requests.with_manifest(
        configuration={**requests.manifest["configuration"], **config.to_manifest(), **engine},
        seeds={"sampling": config.seed, "source": config.seed, "nonce": requests.feed.nonce},
    )
    learning = LearningPlan(config.chosen, config.seed, config.epsilon, config.track)
    return LivePlan(requests, prompts, learning, config.robot, config.skill_set)


def prompt_plan(config: TimelineLive) -> PromptPlan:
    skills = config.skill_set
    given = [_lasting(skills, config.lasting(t_nom_s)) for t_nom_s in config.t_nom_s]
    return PromptPlan(given or [skills], config.tokens_per_skill, config.n_skills, config.task, not config.no_grammar)


def _lasting(skills: SkillSet, durations: Timing) -> SkillSet:
    """Return a skill set in which every skill has the same durations."""
    return replace(skills, skills=tuple(replace(skill, durations=durations) for skill in skills.skills))


def recordings(folder: Path) -> list[Floats]:
    """Return the token times, in s from the request, of the requests that count of a latency or throughput run.

    Raises StoreError without a run, UsageError without tokens.
    """
    run = read_run(folder)
    samples = run.samples
    good = samples[~samples["warmup"] & (samples["error"] == "") & samples["ttft_ns"].notna()]
    tokens = run.tokens.sort_values("index").groupby("request_id")["client_ns"]
    times = {request_id: column.to_numpy(dtype="float64") for request_id, column in tokens}
    answers = [
        (times[sample["request_id"]] - times[sample["request_id"]][0] + float(sample["ttft_ns"])) / 1e9
        for sample in good.to_dict("records")
        if sample["request_id"] in times
    ]
    if not answers:
        raise UsageError(f"`calibrate`: {folder} holds no answers; give the run folder of a latency or throughput run")
    return answers


def _origins(config: TimelineComputed) -> Origins:
    clock = "virtual" if config.virtual else "monotonic"
    cells = {
        name: replace(case.board.provenance, clock=clock)
        for case in config.cases
        for name in (case.setting.name, *(f"{case.setting.name}/{policy}" for policy in config.chosen))
    }
    return Origins(next(iter(cells.values()), Provenance()), cells)


def _facts(board: Board) -> dict[str, Any]:
    """Return a board as plain data, without a recording's gaps."""
    plain = asdict(board) | {"gaps": to_table(board.gaps)}
    plain["gaps"].pop("trace", None)
    return plain
