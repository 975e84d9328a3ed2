"""The sentences, tables and CSV of a run of timelines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

from s2a_bench.experiments import Shown
from s2a_bench.experiments.cells import COUNT, FLAG, SHARE, TIME, Metric
from s2a_bench.experiments.timeline.rows import METRICS
from s2a_bench.experiments.timeline.view.cells import (
    Timelines,
    jitter_notes,
    origin_notes,
    panels,
    seconds,
    timelines_json,
    timelines_of,
)
from s2a_bench.experiments.timeline.view.figures import page_lanes, timeline_figures
from s2a_bench.policy import ONLINE
from s2a_bench.policy.conformal import promise, upper_bound
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.csv_text import SUMMARY, CsvTable
from s2a_bench.writers.tables import ABSENT, TextTable, number


def show(run: StoredRun, **_: Any) -> Shown:
    cells, facts = timelines_of(run), run.manifest
    shape = _common(cells)
    return Shown.build(
        sentences=lambda: _timeline_sentences(cells),
        tables={
            "skills": lambda: skill_table(cells),
            "motion": lambda: _table(cells, f"Motion{shape}", _MOTION, _MOTION_NOTES),
            "waiting": lambda: _table(cells, f"Waiting and age{shape}: times in s", _WAITING, _WAITING_NOTES),
            "timelines": lambda: execution_table(cells, facts),
        },
        main=["timelines"],
        csvs=lambda: timeline_csv(cells),
        figures=lambda: timeline_figures(cells, origin_notes(facts, cells)),
        json=lambda: timelines_json(run, cells),
        lanes=lambda: page_lanes(cells),
    )


def _timeline_sentences(cells: Sequence[Timelines]) -> list[str]:
    policies = dict.fromkeys(cell.policy for cell in cells)
    return [_policy_sentence(policy, [cell for cell in cells if cell.policy == policy]) for policy in policies]


def _policy_sentence(policy: str, cells: Sequence[Timelines]) -> str:
    stalling = [cell for cell in cells if cell.p_any_stall > 0]
    share = f"{max(cell.mean('end_regret') or 0.0 for cell in cells):.0%}"
    late = "it ends as early as S0 allows" if share == "0%" else f"it ends up to {share} later than S0 allows"
    if not stalling:
        return f"{policy} never stalls; {late}."
    worst = max(stalling, key=lambda cell: cell.stall_s)
    plans = len(worst)
    of_plans = ""
    if plans > 1:
        high = upper_bound(int(worst.values("p_any_stall").sum()), plans, 0.975)
        of_plans = f" there {worst.p_any_stall:.1%} of {plans} plans stall (95 % interval up to {high:.1%});"
    where = f"{len(stalling)} of {len(cells)} settings, most" if len(cells) > 1 else "the only setting,"
    most = f"on {worst.first.title} with L = {worst.first.tokens_per_skill}: {worst.stall_s:.2f} s a plan"
    return f"{policy} stalls in {where} {most};{of_plans} {late}."


_EXECUTION = ("start_s", "end_s", "stalls", "stall_s", "longest_stall_s", "start_regret", "end_regret")
_WAITING = (
    "mean_queue_wait_s",
    "longest_queue_wait_s",
    "mean_action_age_s",
    "oldest_action_s",
    "stall_ratio",
    "start_regret_of_wait",
    "start_regret_elastic",
    "end_regret_elastic",
)
_MOTION = ("speed_distortion", "fluidity", "rms_jerk", "peak_jerk", "sparc")
_WAITING_NOTES = (
    "queued: from a skill's arrival to its start. age: to a skill's start, as if pictured at the request.",
    "of wait: start regret over t_N - S0. over S_lo, E_lo: over the least start and end within T_min, T_max.",
)
_MOTION_NOTES = (
    "distortion: durations over nominal ones. fluidity: share of deadlines met (Etalon).",
    "Jerk and SPARC are a model's: a robot at unit speed moves from skill to skill and rests in stalls.",
)


def execution_table(cells: Sequence[Timelines], manifest: Mapping[str, Any]) -> TextTable:
    """Return the table of starts, ends, stalls and regrets: means over the plans, in s."""
    random = _is_random(cells)
    title = f"Timelines{_common(cells)}: times in s{', means' if random else ''}"
    notes = [*origin_notes(manifest, cells), *_plan_notes(cells, manifest), *jitter_notes(manifest)]
    notes.append("stalls: those above 20 ms. late start, late end: regret over clairvoyant S0 and S0 + P_N.")
    return _table(cells, title, (*_EXECUTION, "p_any_stall") if random else _EXECUTION, notes)


def skill_table(cells: Sequence[Timelines]) -> TextTable:
    groups = []
    for cell in cells:
        name = (cell.first.title, str(cell.first.tokens_per_skill), cell.policy)
        rows: list[tuple[str, ...]] = []
        for skill in cell.skills:
            taken_ns, waited_ns = skill.end_ns - skill.start_ns, skill.start_ns - skill.arrival_ns
            times_ns = (skill.arrival_ns, skill.start_ns, skill.end_ns, skill.stall_ns, waited_ns)
            times = (seconds(each / 1e9) for each in times_ns)
            rows.append((*name, skill.text or str(skill.index + 1), *times, f"{taken_ns / skill.nominal_ns:.2f}"))
        groups.append(rows)
    names = (cell.first.cell for cell in cells for _ in cell.skills)
    header = ("board", "L", "policy", "skill", "arrives", "starts", "ends", "stall before", "queue wait", "stretch")
    plan = "the first plan, times in s" if _is_random(cells) else "times in s"
    return TextTable.grouped(f"Skills{_common(cells)}: {plan}", header, groups, 4, once=3, cells=names)


def timeline_csv(cells: Iterable[Timelines]) -> dict[str, CsvTable]:
    """Return file name -> CSV table in long form, unrounded, times in s; absent values have no row."""
    rows = []
    for cell in cells:
        for name, metric in METRICS.items():
            if summary := cell.summary(name):
                statistics = ("n", "mean") if metric.kind == FLAG else SUMMARY
                values = (getattr(summary, each) if each in statistics else None for each in SUMMARY)
                rows.append((cell.first.cell, name, *values))
    return {"timelines.csv": CsvTable.of(("cell", "metric", *SUMMARY), rows)}


def _table(cells: Sequence[Timelines], title: str, metrics: Sequence[str], notes: Iterable[str]) -> TextTable:
    """Return a table of means, a group of rows a board."""
    several, shown = len({cell.shape for cell in cells}) > 1, [METRICS[name] for name in metrics]
    boards: dict[str, list[tuple[str, ...]]] = {}
    names: dict[str, list[str]] = {}
    for panel in panels(cells):
        name, tokens, n_skills, t_nom_s = panel.cells[0].setting
        board = name + (f", N {n_skills}, T {t_nom_s:g}" if several else "")
        for place, cell in enumerate(panel.cells):
            row = (board, "" if place else str(tokens), cell.policy, *(_entry(cell, metric) for metric in shown))
            boards.setdefault(board, []).append(row)
            names.setdefault(board, []).append(cell.first.cell)
    header = ("board", "L", "policy", *(metric.title for metric in shown))
    return TextTable.grouped(title, header, boards.values(), 3, notes, once=1, cells=chain(*names.values()))


def _entry(cell: Timelines, metric: Metric) -> str:
    value = cell.mean(metric.name)
    if value is None:
        return ABSENT
    if metric.kind == TIME:
        return seconds(value)
    if metric.kind == FLAG:
        return f"{value:.1%}"
    if metric.kind == SHARE:
        return f"{value:.0%}" if abs(value) >= 0.0995 or not value else f"{round(value, 3) + 0.0:.1%}"  # noqa: PLR2004 - two digits
    if metric.kind == COUNT:
        return f"{value:.0f}" if len(cell) == 1 else f"{value:.2f}"
    return number(value)


def _is_random(cells: Iterable[Timelines]) -> bool:
    """Return whether a cell has several plans."""
    return any(len(cell) > 1 for cell in cells)


def _common(cells: Sequence[Timelines]) -> str:
    """Return N and T_nom if all cells share them."""
    shapes = {cell.shape for cell in cells}
    return "" if len(shapes) != 1 else ", N = {}, T_nom = {:g} s".format(*shapes.pop())


def _plan_notes(cells: Sequence[Timelines], manifest: Mapping[str, Any]) -> list[str]:
    """Return the number of plans, and the calibration or prior of stream-to-act."""
    notes = []
    if _is_random(cells):
        moved = max(cell.values("rms_jerk").size for cell in cells)
        notes.append(f"{max(map(len, cells))} plans a cell, the same for every policy; motion: of the first {moved}.")
    ours = [cell.first for cell in cells if cell.policy == ONLINE]
    if calibrations := manifest.get("calibrations"):
        cautions = [each["caution"] for each in calibrations.values() if each["caution"] is not None]
        span = " to ".join(f"{end:g}" for end in sorted({min(cautions), max(cautions)})) if cautions else "infinite"
        plans_each = next(iter(calibrations.values()))["plans"]
        kind = "recorded" if manifest["configuration"].get("calibrate") else "other"
        notes.append(f"stream-to-act: lambda {span}, calibrated on {plans_each} {kind} plans a setting.")
        notes.append(promise(calibrations, "lambda", "plans"))
    elif live := [plan for plan in ours if plan.mode == "live"]:
        known = sorted({plan.caution for plan in live if plan.caution is not None})
        span = ", ".join(f"{caution:g}" for caution in known) or "infinite"
        notes.append(f"stream-to-act: lambda {span}, not calibrated; its prior is from the warm-ups, or the pace.")
    elif any(plan.mode == "virtual" for plan in ours):
        notes.append("Nothing varies, and stream-to-act's prior knows it: it starts at S0.")
    return notes
