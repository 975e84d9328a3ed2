"""Timelines in real time: a board's tokens played on the system clock, every policy executing them at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.clock import SystemClock
from s2a_bench.experiments.timeline.config import TimelineConfig, settings
from s2a_bench.experiments.timeline.execution import SideBySide, jitter_facts, keep, quick_switching
from s2a_bench.experiments.timeline.following import Following
from s2a_bench.experiments.timeline.plans import Board
from s2a_bench.experiments.timeline.policies import draw, learn
from s2a_bench.experiments.timeline.rows import SKILLS, TIMELINES
from s2a_bench.experiments.timeline.to_rows import KEPT_PLANS, Setting
from s2a_bench.experiments.timeline.traces import recordings
from s2a_bench.experiments.timeline.virtual import board_facts, calibration_warnings, origins_of
from s2a_bench.experiments.timeline.watch import Scene
from s2a_bench.machine import environment
from s2a_bench.plan import Call, Durations, Skill
from s2a_bench.policy import Plans
from s2a_bench.policy.schedule import safe_start
from s2a_bench.progress import Progress, watching
from s2a_bench.runtime.events import Requested, SkillCame, StreamEnded, TokenCame
from s2a_bench.runtime.executor import SILENCE_S
from s2a_bench.runtime.record import Record
from s2a_bench.runtime.timed import TimedRobot
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import TOKENS, TokenRow
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.policy import Floats

MODE = "real-time"


@dataclass(frozen=True, slots=True)
class _Play:
    """One plan to be played: when its tokens come, and what they say."""

    token_s: Floats
    plans: Plans
    """Of shape (N, 1)."""

    @property
    def calls(self) -> list[Call]:
        """Return the skills; nobody wrote them, so they are numbers with durations."""
        times = zip(self.plans.least_s[:, 0], self.plans.nominal_s[:, 0], self.plans.most_s[:, 0], strict=True)
        return [
            Call(Skill(f"skill{number}", (), Durations(*map(float, durations)), "hold"), ())
            for number, durations in enumerate(times, start=1)
        ]

    @property
    def span_s(self) -> float:
        """Return when the last policy ends: the one that waits."""
        return float(self.plans.arrival_s[-1, 0] + self.plans.nominal_s.sum())


@dataclass(slots=True)
class _SoFar:
    """What is said of the whole run at its end, however it ends."""

    records: list[Record] = field(default_factory=list)
    warnings: list[RunWarning] = field(default_factory=list)
    calibrations: dict[str, Any] = field(default_factory=dict)


def run_real_time(config: TimelineConfig, output: Path, progress: Progress) -> Path:
    """Play all timelines, one setting after the other, and return the run folder; raises S2AError.

    Nothing is measured of a model: arrivals are emulated, executions are real.
    """
    answers = recordings(config.calibrate) if config.calibrate else []
    work = [(board, replace(setting, mode=MODE)) for board, setting in settings(config)]
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "boards": [board_facts(board) for board in config.boards],
        "provenance": origins_of(config, work).to_manifest(),
    }
    with RunWriter.create(output, "timeline", manifest, (TIMELINES, SKILLS, TOKENS)) as writer, quick_switching():
        progress.opened(writer.path)
        progress.expect(len(work) * config.plans_a_cell)
        so_far = _SoFar()
        try:
            for board, setting in work:
                _run_setting(config, board, setting, answers, writer, progress, so_far)
        finally:
            warnings = [*so_far.warnings, *calibration_warnings(so_far.calibrations)]
            writer.update(
                calibrations=so_far.calibrations,
                start_jitter=jitter_facts(so_far.records),
                warnings=[warning.to_manifest() for warning in warnings],
            )
        return writer.path


def _run_setting(
    config: TimelineConfig,
    board: Board,
    setting: Setting,
    answers: Sequence[Floats],
    writer: RunWriter,
    progress: Progress,
    so_far: _SoFar,
) -> None:
    """Play the plans of one setting."""
    progress.stage(f"learning {setting.title}")
    known = learn(config, board, setting, answers)
    made = {name: known.prepare(policy) for name, policy in config.chosen.items()}
    so_far.calibrations |= known.facts(setting)
    every = {name: known.tracked(policy) for name, policy in config.chosen.items() if config.tracks}
    tracked = {name: each for name, each in every.items() if each is not None}
    following = Following(config.shape(setting), made, tracked, config.track_file)
    token_s, plans = draw(config, board, setting, config.plans_a_cell, "plans")
    for plan in range(config.plans_a_cell):
        cut = slice(plan, plan + 1)
        one = Plans(plans.arrival_s[:, cut], plans.nominal_s[:, cut], plans.least_s[:, cut], plans.most_s[:, cut])
        play = _Play(token_s[:, plan], one)
        progress.stage(f"{setting.title}, L = {setting.tokens_per_skill}: about {play.span_s:.0f} s")
        known_too = replace(config.shape(setting), safe_start_s=float(safe_start(one.arrival_s, one.nominal_s)[0]))
        policies = following.policies()
        robots = [TimedRobot() for _ in policies]
        executors = SideBySide(policies, known_too, "hold", robots, max(SILENCE_S, 2 * play.span_s))
        title = f"{setting.title}, {setting.tokens_per_s:g} tokens/s, L = {setting.tokens_per_skill} (EMULATED)"
        try:
            with executors, watching(progress, Scene(title, executors.records, setting.n_skills, play.span_s)):
                _play(play, setting.tokens_per_skill, executors)
        finally:  # what an interruption leaves is kept too
            so_far.records += executors.records
            request_id = setting.request_id(plan)
            if plan < KEPT_PLANS:
                writer.append(TOKENS, _token_rows(setting, request_id, executors.records[0]))
            so_far.warnings += keep(writer, setting, plan, request_id, policies, executors.records)
        following.learn(executors.records)
        progress.advance()


def _play(play: _Play, tokens_per_skill: int, executors: SideBySide) -> None:
    """Tell the executors of every token at its time, and wait until they are done."""
    clock = SystemClock()
    requested_ns = clock.now_ns()
    executors.tell(Requested(requested_ns))
    calls = iter(play.calls)
    for place, due_s in enumerate(play.token_s, start=1):
        clock.sleep_until_ns(requested_ns + round(float(due_s) * 1e9))
        at_ns = clock.now_ns()
        executors.tell(TokenCame(at_ns))
        if place % tokens_per_skill == 0:
            executors.tell(SkillCame(at_ns, next(calls)))
    executors.tell(StreamEnded(clock.now_ns()))
    executors.finish()


def _token_rows(setting: Setting, request_id: str, record: Record) -> list[TokenRow]:
    """List the tokens as they were heard."""
    return [
        TokenRow(request_id, setting.name, index, -1, "", None, at_ns) for index, at_ns in enumerate(record.token_ns)
    ]
