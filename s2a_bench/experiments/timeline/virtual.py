"""The timeline run in virtual time: every policy on the same arrivals, board by board, granularity by granularity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.boards.gaps import to_table
from s2a_bench.experiments.timeline.config import TimelineConfig, settings
from s2a_bench.experiments.timeline.plans import Board
from s2a_bench.experiments.timeline.policies import Knowledge, draw, finite, learn, plans_of
from s2a_bench.experiments.timeline.rows import SKILLS, TIMELINES
from s2a_bench.experiments.timeline.to_rows import Setting, skill_rows, timeline_rows, token_rows
from s2a_bench.experiments.timeline.traces import recordings
from s2a_bench.machine import environment
from s2a_bench.policy import Plans, Policy, Schedule
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.requests import TOKENS
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.progress import Progress


def run_virtual(config: TimelineConfig, output: Path, progress: Progress) -> Path:
    """Compute all timelines and return the run folder; raises S2AError for what a user can mend."""
    work = list(settings(config))
    answers = recordings(config.calibrate) if config.calibrate else []
    for _, setting in work if answers else ():
        plans_of(config, setting, answers)  # what is wrong shows before there is a folder
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "boards": [board_facts(board) for board in config.boards],
        "provenance": origins_of(config, work).to_manifest(),
    }
    with RunWriter.create(output, "timeline", manifest, (TIMELINES, SKILLS, TOKENS)) as writer:
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
    config: TimelineConfig, board: Board, setting: Setting, answers: Sequence[Floats], writer: RunWriter
) -> dict[str, Any]:
    """Draw one setting's plans, let every policy decide them, keep the rows and return the calibrations."""
    known = learn(config, board, setting, answers)
    token_s, plans = draw(config, board, setting, config.plans_a_cell, "plans")
    request_ids = [setting.request_id(plan) for plan in range(config.plans_a_cell)]
    writer.append(TOKENS, token_rows(setting.name, token_s, request_ids))
    for name, chosen in config.chosen.items():
        caution, schedule = _decide(known, chosen, plans, track=config.tracks)
        rows = timeline_rows(setting, name, plans, schedule, request_ids, caution=caution)
        writer.append(TIMELINES, rows)
        writer.append(SKILLS, skill_rows(rows[0].cell, plans, schedule, request_ids))
    return known.facts(setting)


def _decide(
    known: Knowledge, chosen: Policy, plans: Plans, *, track: bool
) -> tuple[float | Sequence[float | None] | None, Schedule]:
    """Return a policy's lambda, of each plan where it follows them, and what it makes of the plans."""
    tracked = known.tracked(chosen) if track else None
    if tracked is not None:
        cautions, schedule = tracked.follow(plans)
        return [finite(float(caution)) for caution in cautions], schedule
    policy = known.prepare(chosen)
    return finite(getattr(policy, "caution", None)), policy.schedule(plans)


def origins_of(config: TimelineConfig, work: Sequence[tuple[Board, Setting]]) -> Origins:
    """Return where the numbers of each timeline come from: its board's tokens."""
    clock = {setting.mode: "virtual" if setting.mode == "virtual" else "monotonic" for _, setting in work}
    cells = {
        name: replace(board.provenance, clock=clock[setting.mode])
        for board, setting in work
        for name in (setting.name, *(f"{setting.name}/{policy}" for policy in config.chosen))
    }
    return Origins(next(iter(cells.values()), Provenance()), cells)


def board_facts(board: Board) -> dict[str, Any]:
    """Return a board as plain data; a recording as its family alone."""
    plain = asdict(board) | {"gaps": to_table(board.gaps)}
    plain["gaps"].pop("trace", None)
    return plain


def calibration_warnings(calibrations: dict[str, Any]) -> list[RunWarning]:
    """Return where stream-to-act could not be calibrated well."""
    waits = [name for name, found in calibrations.items() if found["caution"] is None]
    if not waits:
        return []
    return [
        RunWarning(
            "calibration-waits",
            f"stream-to-act waits for the whole plan in {', '.join(waits)}: no smaller lambda kept stalls rare enough",
            "allow more stalls with --epsilon, or calibrate on more plans with --calibration-plans",
        )
    ]
