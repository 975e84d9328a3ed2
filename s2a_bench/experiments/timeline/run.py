"""A timeline run on boards' tokens, every policy on the same arrivals: computed, or played on the system clock."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from s2a_bench.act.events import Requested, SkillArrived, StreamEnded, TokenArrived
from s2a_bench.act.executor import SILENCE_S
from s2a_bench.act.record import Record
from s2a_bench.act.timed import TimedRobot
from s2a_bench.boards.gaps import to_table
from s2a_bench.boards.tokens import Board
from s2a_bench.clock import SystemClock, quick_switching
from s2a_bench.errors import UsageError
from s2a_bench.experiments.timeline.build_rows import timeline_rows
from s2a_bench.experiments.timeline.config import TimelineComputed, TimelineRealTime
from s2a_bench.experiments.timeline.execution import SideBySide, jitter_facts, keep
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.watch import Scene
from s2a_bench.harness.timelines.cases import LearningPlan, PlanCase, PlanSetting
from s2a_bench.harness.timelines.policies import Following, draw, finite, learn, plans_of
from s2a_bench.harness.timelines.rows import KEPT_PLANS, skill_rows, token_rows
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.machine import environment
from s2a_bench.plan import Call, Skill
from s2a_bench.policy import Floats, Plans
from s2a_bench.policy.conformal import take
from s2a_bench.policy.schedule import safe_start
from s2a_bench.progress import Progress, watching
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import SKILLS, TOKENS, TokenRow
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.store.schema import Table
from s2a_bench.types import Timing

TABLES: Final = (TIMELINES, SKILLS, TOKENS)


@dataclass(frozen=True, slots=True)
class ModelledPlan:
    """A run of timelines on modelled tokens, computed or played."""

    cases: Sequence[PlanCase]
    plans: int
    """Plans of a case."""
    learning: LearningPlan
    manifest: dict[str, Any]


def resolve(config: TimelineComputed) -> ModelledPlan:
    """Derive the run plan from a configuration; raises S2AError for recorded answers that are missing or too short."""
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "boards": [_facts(board) for board in config.boards],
        "provenance": _origins(config).to_manifest(),
    }
    learning = LearningPlan(
        policies=config.named_policies,
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


def run_timeline(config: TimelineComputed, output: Path, progress: Progress) -> Path:
    plan = resolve(config)
    with RunWriter.create(output, "timeline", plan.manifest, TABLES) as writer:
        progress.opened(writer.path)
        progress.stage("computing timelines")
        if plan.learning.random:
            progress.expect(len(plan.cases))
        calibrations: dict[str, Any] = {}
        for case in plan.cases:
            token_s, plans = draw(case, plan.learning.seed, plan.plans, "plans")
            following = learn(case, plan.learning)
            for table, rows in computed_rows(case.setting, following, token_s, plans):
                writer.append(table, rows)
            calibrations |= following.facts(case.setting)
            if plan.learning.random:
                progress.advance()
        writer.update(calibrations=calibrations, warnings=calibration_warnings(calibrations))
        return writer.path


def computed_rows(
    setting: PlanSetting, following: Following, token_s: Floats, plans: Plans
) -> Iterator[tuple[Table[Any], Iterable[Any]]]:
    """Decide plans under every policy, and yield their rows for each table."""
    request_ids = [setting.request_id(plan) for plan in range(token_s.shape[1])]
    yield TOKENS, token_rows(setting.name, token_s, request_ids)
    for name, policy in following.by_name.items():
        if name in following.tracked:
            followed, schedule = following.tracked[name].follow(plans)
            cautions = [finite(float(caution)) for caution in followed]
        else:
            cautions, schedule = [finite(policy.caution)] * len(request_ids), policy.schedule(plans)
        rows = timeline_rows(setting, name, plans, schedule, request_ids, cautions=cautions)
        yield TIMELINES, rows
        yield SKILLS, skill_rows(rows[0].cell, plans, schedule, request_ids)


def calibration_warnings(calibrations: dict[str, Any]) -> list[RunWarning]:
    """Return where stream-to-act could not be calibrated well."""
    waits = [name for name, calibration in calibrations.items() if calibration["caution"] is None]
    waiting = RunWarning(
        "calibration-waits",
        f"stream-to-act waits for the whole plan in {', '.join(waits)}: no smaller lambda kept stalls rare enough",
        "allow more stalls with --epsilon, or calibrate on more plans with --calibration-plans",
    )
    return [*([waiting] if waits else []), *exchange_warnings(calibrations, "follow lambda with --track")]


def run_real_time(config: TimelineRealTime, output: Path, progress: Progress) -> Path:
    """Play all timelines, one setting after the other, and return the run folder; raises S2AError.

    Arrivals are emulated, executions are real.
    """
    plan = resolve(config)
    with RunWriter.create(output, "timeline", plan.manifest, TABLES) as writer, quick_switching():
        progress.opened(writer.path)
        progress.expect(len(plan.cases) * plan.plans)
        run = _RealTime(plan, writer, progress)
        try:
            for case in plan.cases:
                run.play(case)
        finally:
            writer.update(
                calibrations=run.calibrations,
                start_jitter=jitter_facts(run.records),
                warnings=[*run.warnings, *calibration_warnings(run.calibrations)],
            )
        return writer.path


@dataclass(slots=True)
class _RealTime:
    """A run in progress, and the facts that it writes when it ends."""

    plan: ModelledPlan
    writer: RunWriter
    progress: Progress
    records: list[Record] = field(default_factory=list)
    warnings: list[RunWarning] = field(default_factory=list)
    calibrations: dict[str, Any] = field(default_factory=dict)

    def play(self, case: PlanCase) -> None:
        self.progress.stage(f"learning {case.setting.title}")
        following = learn(case, self.plan.learning)
        self.calibrations |= following.facts(case.setting)
        token_s, plans = draw(case, self.plan.learning.seed, self.plan.plans, "plans")
        for place in range(self.plan.plans):
            self._execute(case.setting, place, token_s[:, place], take(plans, np.array([place])), following)
            self.progress.advance()

    def _execute(self, setting: PlanSetting, plan: int, token_s: Floats, plans: Plans, following: Following) -> None:
        span_s = float(plans.arrival_s[-1, 0] + plans.nominal_s.sum())  # the end of the policy that waits for the plan
        self.progress.stage(f"{setting.title}, L = {setting.tokens_per_skill}: about {span_s:.0f} s")
        safe_s = float(safe_start(plans.arrival_s, plans.nominal_s)[0])
        shape = replace(following.shape, safe_start_s=safe_s)
        policies = following.policies()
        robots = [TimedRobot() for _ in policies]
        executors = SideBySide(policies, shape, "hold", robots, max(SILENCE_S, 2 * span_s))
        title = f"{setting.title}, {setting.tokens_per_s:g} tokens/s, L = {setting.tokens_per_skill} (EMULATED)"
        try:
            with executors, watching(self.progress, Scene(title, executors.records, setting.n_skills, span_s)):
                _play(token_s, plans, setting.tokens_per_skill, executors)
        finally:  # also after an interruption
            self.records += executors.records
            request_id = setting.request_id(plan)
            if plan < KEPT_PLANS:
                token_ns = enumerate(executors.records[0].token_ns)
                rows = [TokenRow(request_id, setting.name, index, -1, "", None, at_ns) for index, at_ns in token_ns]
                self.writer.append(TOKENS, rows)
            self.warnings += keep(self.writer, setting, plan, request_id, policies, executors.records)
        following.learn(executors.records)


def _play(token_s: Floats, plans: Plans, tokens_per_skill: int, executors: SideBySide) -> None:
    """Send every token to the executors at its time, and wait until they finish."""
    clock = SystemClock()
    requested_ns = clock.now_ns()
    executors.send(Requested(requested_ns))
    durations = zip(plans.nominal_s[:, 0], plans.least_s[:, 0], plans.most_s[:, 0], strict=True)
    skills = (Timing(*map(float, each)) for each in durations)
    calls = (Call(Skill(f"skill{number}", (), each, "hold"), ()) for number, each in enumerate(skills, start=1))
    for place, due_s in enumerate(token_s, start=1):
        clock.sleep_until_ns(requested_ns + round(float(due_s) * 1e9))
        at_ns = clock.now_ns()
        executors.send(TokenArrived(at_ns))
        if place % tokens_per_skill == 0:
            executors.send(SkillArrived(at_ns, next(calls)))
    executors.send(StreamEnded(clock.now_ns()))
    executors.finish()


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
        for name in (case.setting.name, *(f"{case.setting.name}/{policy}" for policy in config.named_policies))
    }
    return Origins(next(iter(cells.values()), Provenance()), cells)


def _facts(board: Board) -> dict[str, Any]:
    """Return a board as plain data, without a recording's gaps."""
    plain = asdict(board) | {"gaps": to_table(board.gaps)}
    plain["gaps"].pop("trace", None)
    return plain
