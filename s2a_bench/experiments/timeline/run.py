"""A timeline run on boards' tokens, every policy on the same arrivals: computed, or played on the system clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.act.events import Requested, SkillArrived, StreamEnded, TokenArrived
from s2a_bench.act.executor import SILENCE_S
from s2a_bench.act.record import Record
from s2a_bench.act.timed import TimedRobot
from s2a_bench.boards.gaps import to_table
from s2a_bench.boards.tokens import Board
from s2a_bench.clock import SystemClock, quick_switching
from s2a_bench.errors import UsageError
from s2a_bench.experiments.timeline.build_rows import timeline_rows
from s2a_bench.experiments.timeline.execution import SideBySide, jitter_facts, keep
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.watch import Scene
from s2a_bench.harness.timelines.config import PlanSetting, TimelineConfig, settings
from s2a_bench.harness.timelines.policies import Following, Knowledge, draw, finite, learn, plans_of
from s2a_bench.harness.timelines.rows import KEPT_PLANS, skill_rows, token_rows
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.machine import environment
from s2a_bench.plan import Call, Skill
from s2a_bench.policy import Plans, Policy, Schedule
from s2a_bench.policy.schedule import safe_start
from s2a_bench.progress import Progress, watching
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import SKILLS, TOKENS, TokenRow
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.types import Timing

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
MODE = "real-time"


def run_timeline(config: TimelineConfig, output: Path, progress: Progress) -> Path:
    if config.live:
        from s2a_bench.experiments.timeline.live import run_live

        return run_live(config, output, progress)
    if config.real_time:
        return run_real_time(config, output, progress)
    work = list(settings(config))
    answers = recordings(config.calibrate) if config.calibrate else []
    for _, setting in work if answers else ():
        plans_of(config, setting, answers)  # refuse before the folder is created
    with RunWriter.create(output, "timeline", manifest_of(config, work), (TIMELINES, SKILLS, TOKENS)) as writer:
        progress.opened(writer.path)
        progress.stage("computing timelines")
        if config.random:
            progress.expect(len(work))
        calibrations: dict[str, Any] = {}
        for board, setting in work:
            calibrations |= _compute(config, board, setting, answers, writer)
            if config.random:
                progress.advance()
        warnings = calibration_warnings(calibrations)
        writer.update(calibrations=calibrations, warnings=[warning.to_manifest() for warning in warnings])
        return writer.path


def _compute(
    config: TimelineConfig, board: Board, setting: PlanSetting, answers: Sequence[Floats], writer: RunWriter
) -> dict[str, Any]:
    known = learn(config, board, setting, answers)
    token_s, plans = draw(config, board, setting, config.plans_a_cell, "plans")
    request_ids = [setting.request_id(plan) for plan in range(config.plans_a_cell)]
    writer.append(TOKENS, token_rows(setting.name, token_s, request_ids))
    for name, chosen in config.chosen.items():
        caution, schedule = _decide(known, chosen, plans, track=config.track)
        rows = timeline_rows(setting, name, plans, schedule, request_ids, caution=caution)
        writer.append(TIMELINES, rows)
        writer.append(SKILLS, skill_rows(rows[0].cell, plans, schedule, request_ids))
    return known.facts(setting)


def _decide(
    known: Knowledge, chosen: Policy, plans: Plans, *, track: bool
) -> tuple[float | Sequence[float | None] | None, Schedule]:
    """Return a policy's lambda, one a plan if it tracks them, and its schedule."""
    tracked = known.tracked(chosen) if track else None
    if tracked is not None:
        cautions, schedule = tracked.follow(plans)
        return [finite(float(caution)) for caution in cautions], schedule
    policy = known.prepare(chosen)
    return finite(policy.caution), policy.schedule(plans)


def manifest_of(config: TimelineConfig, work: Sequence[tuple[Board, PlanSetting]]) -> dict[str, Any]:
    return {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "boards": [_facts(board) for board in config.boards],
        "provenance": _origins(config, work).to_manifest(),
    }


def _origins(config: TimelineConfig, work: Sequence[tuple[Board, PlanSetting]]) -> Origins:
    clock = {setting.mode: "virtual" if setting.mode == "virtual" else "monotonic" for _, setting in work}
    cells = {
        name: replace(board.provenance, clock=clock[setting.mode])
        for board, setting in work
        for name in (setting.name, *(f"{setting.name}/{policy}" for policy in config.chosen))
    }
    return Origins(next(iter(cells.values()), Provenance()), cells)


def _facts(board: Board) -> dict[str, Any]:
    """Return a board as plain data, without a recording's gaps."""
    plain = asdict(board) | {"gaps": to_table(board.gaps)}
    plain["gaps"].pop("trace", None)
    return plain


def calibration_warnings(calibrations: dict[str, Any]) -> list[RunWarning]:
    """Return where stream-to-act could not be calibrated well."""
    waits = [name for name, found in calibrations.items() if found["caution"] is None]
    waiting = RunWarning(
        "calibration-waits",
        f"stream-to-act waits for the whole plan in {', '.join(waits)}: no smaller lambda kept stalls rare enough",
        "allow more stalls with --epsilon, or calibrate on more plans with --calibration-plans",
    )
    return [*([waiting] if waits else []), *exchange_warnings(calibrations, "follow lambda with --track")]


def recordings(folder: Path) -> list[Floats]:
    """Return the token times, in s from the request, of the requests that count of a latency or throughput run.

    Raises StoreError without a run, UsageError without tokens.
    """
    run = read_run(folder)
    samples = run.samples
    good = samples[~samples["warmup"] & (samples["error"] == "") & samples["ttft_ns"].notna()]
    tokens = run.tokens.sort_values("index").groupby("request_id")["client_ns"]
    times = {request_id: column.to_numpy(dtype="float64") for request_id, column in tokens}
    found = [
        (times[sample["request_id"]] - times[sample["request_id"]][0] + float(sample["ttft_ns"])) / 1e9
        for sample in good.to_dict("records")
        if sample["request_id"] in times
    ]
    if not found:
        raise UsageError(f"`calibrate`: {folder} holds no answers; give the run folder of a latency or throughput run")
    return found


def run_real_time(config: TimelineConfig, output: Path, progress: Progress) -> Path:
    """Play all timelines, one setting after the other, and return the run folder; raises S2AError.

    Arrivals are emulated, executions are real.
    """
    answers = recordings(config.calibrate) if config.calibrate else []
    work = [(board, replace(setting, mode=MODE)) for board, setting in settings(config)]
    tables = (TIMELINES, SKILLS, TOKENS)
    with RunWriter.create(output, "timeline", manifest_of(config, work), tables) as writer, quick_switching():
        progress.opened(writer.path)
        progress.expect(len(work) * config.plans_a_cell)
        run = _RealTime(config, answers, writer, progress)
        try:
            for board, setting in work:
                run.play(board, setting)
        finally:
            warnings = [*run.warnings, *calibration_warnings(run.calibrations)]
            writer.update(
                calibrations=run.calibrations,
                start_jitter=jitter_facts(run.records),
                warnings=[warning.to_manifest() for warning in warnings],
            )
        return writer.path


@dataclass(slots=True)
class _RealTime:
    """A run in progress, and the facts that it writes when it ends."""

    config: TimelineConfig
    answers: Sequence[Floats]
    writer: RunWriter
    progress: Progress
    records: list[Record] = field(default_factory=list)
    warnings: list[RunWarning] = field(default_factory=list)
    calibrations: dict[str, Any] = field(default_factory=dict)

    def play(self, board: Board, setting: PlanSetting) -> None:
        config = self.config
        self.progress.stage(f"learning {setting.title}")
        known = learn(config, board, setting, self.answers)
        made = {name: known.prepare(policy) for name, policy in config.chosen.items()}
        self.calibrations |= known.facts(setting)
        every = {name: known.tracked(policy) for name, policy in config.chosen.items() if config.track}
        tracked = {name: each for name, each in every.items() if each is not None}
        following = Following(config.shape(setting), made, tracked)
        token_s, plans = draw(config, board, setting, config.plans_a_cell, "plans")
        for plan in range(config.plans_a_cell):
            cut = slice(plan, plan + 1)
            one = Plans(plans.arrival_s[:, cut], plans.nominal_s[:, cut], plans.least_s[:, cut], plans.most_s[:, cut])
            self._execute(setting, plan, token_s[:, plan], one, following)
            self.progress.advance()

    def _execute(self, setting: PlanSetting, plan: int, token_s: Floats, plans: Plans, following: Following) -> None:
        span_s = float(plans.arrival_s[-1, 0] + plans.nominal_s.sum())  # the end of the policy that waits for the plan
        self.progress.stage(f"{setting.title}, L = {setting.tokens_per_skill}: about {span_s:.0f} s")
        safe_s = float(safe_start(plans.arrival_s, plans.nominal_s)[0])
        shape = replace(self.config.shape(setting), safe_start_s=safe_s)
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
