"""The tables of a timeline run for people, and for programs as CSV."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.timeline.metrics import COUNT, FLAG, METRICS, SHARE, TIME, TimelineMetric
from s2a_bench.experiments.timeline.view.cells import (
    Timelines,
    jitter_notes,
    origin_notes,
    panels,
    timelines_of,
)
from s2a_bench.writers.csv_text import SUMMARY, CsvTable
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

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


def execution_table(run: Run) -> TextTable:
    """Lay out starts, ends, stalls and regrets: means over the plans, in s."""
    cells = timelines_of(run)
    random = any(cell.n > 1 for cell in cells)
    header, rows, rules = _rows(cells, (*_EXECUTION, *(["p_any_stall"] if random else [])))
    title = f"Timelines{_common(cells)}: times in s{', means' if random else ''}"
    notes = [*origin_notes(run, cells), *_plan_notes(run, cells), *jitter_notes(run)]
    notes.append("stalls: those above 20 ms. late start, late end: regret over clairvoyant S0 and S0 + P_N.")
    return TextTable(title, header, rows, 3, rules, tuple(notes))


def waiting_table(run: Run) -> TextTable:
    """Lay out how long skills lie ready, how old the picture is that is acted on, and further regrets."""
    cells = timelines_of(run)
    notes = (
        "queued: from a skill's arrival to its start. age: from the request, as if pictured then, to a skill's start.",
        "of wait: start regret over t_N - S0. over S_lo, E_lo: over the least start and end within T_min, T_max.",
    )
    header, rows, rules = _rows(cells, _WAITING)
    return TextTable(f"Waiting and age{_common(cells)}: times in s", header, rows, 3, rules, notes)


def motion_table(run: Run) -> TextTable:
    """Lay out how even the motion is."""
    cells = timelines_of(run)
    notes = (
        "distortion: durations over nominal ones. fluidity: share of deadlines met (Etalon).",
        "Jerk and SPARC are a model's: a robot at unit speed flows from skill to skill and rests in stalls.",
    )
    header, rows, rules = _rows(cells, _MOTION)
    return TextTable(f"Motion{_common(cells)}", header, rows, 3, rules, notes)


def skill_table(cells: Sequence[Timelines]) -> TextTable:
    """Lay out every skill of the shown plan of some cells."""
    rows: list[tuple[str, ...]] = []
    rules = set()
    for cell in cells:
        rules.add(len(rows))
        for place, skill in enumerate(cell.skills.to_dict("records")):
            times = [skill[f"{name}_ns"] / 1e9 for name in ("arrival", "start", "end", "stall", "queue_wait")]
            title, tokens = (cell.setting[0], str(cell.setting[1])) if not place else ("", "")
            name = [title, tokens, cell.policy if not place else "", skill["text"] or str(skill["index"] + 1)]
            rows.append((*name, *(seconds(value) for value in times), f"{skill['stretch']:.2f}"))
    header = ("board", "L", "policy", "skill", "arrives", "starts", "ends", "stall before", "queue wait", "stretch")
    plan = "the first plan, times in s" if any(cell.n > 1 for cell in cells) else "times in s"
    return TextTable(f"Skills{_common(cells)}: {plan}", header, rows, 4, frozenset(rules - {0}))


def timeline_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name; what is compared comes last."""
    return {
        "skills": skill_table(timelines_of(run)),
        "motion": motion_table(run),
        "waiting": waiting_table(run),
        "timelines": execution_table(run),
    }


def timeline_csv(run: Run) -> dict[str, CsvTable]:
    """Return file name -> CSV table in long form, every digit kept, times in s; what is absent has no row."""
    summaries = []
    for cell in timelines_of(run):
        for name, metric in METRICS.items():
            if found := cell.summary(name):
                parts = ("n", "mean") if metric.kind == FLAG else SUMMARY
                values = (getattr(found, part) if part in parts else None for part in SUMMARY)
                summaries.append((cell.about("cell"), name, *values))
    return {"timelines.csv": CsvTable.of(("cell", "metric", *SUMMARY), summaries)}


def seconds(value: float) -> str:
    """Write a time in s: two decimals below 100, one above."""
    return f"{value:.2f}" if abs(value) < 99.995 else f"{value:.1f}"  # noqa: PLR2004 - five characters at most


def _rows(
    cells: Sequence[Timelines], metrics: Sequence[str]
) -> tuple[tuple[str, ...], list[tuple[str, ...]], frozenset[int]]:
    """Return header, rows and rules: a group of rows a board, L where it begins."""
    rows: list[tuple[str, ...]] = []
    rules = []
    last = ""
    for (title, tokens, n_skills, t_nom_s), group in panels(cells):
        several = f", N {n_skills}, T {t_nom_s:g}" if len({cell.setting[2:] for cell in cells}) > 1 else ""
        board = title + several
        if board != last:
            rules.append(len(rows))
        for place, cell in enumerate(group):
            names = (board if board != last else "", str(tokens) if not place else "", cell.policy)
            rows.append((*names, *(_entry(cell, METRICS[name]) for name in metrics)))
            last = board
    return ("board", "L", "policy", *(METRICS[name].title for name in metrics)), rows, frozenset(rules[1:])


def _entry(cell: Timelines, metric: TimelineMetric) -> str:
    """Write a metric's mean."""
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
        return f"{value:.0f}" if cell.n == 1 else f"{value:.2f}"
    return number(value)


def _common(cells: Sequence[Timelines]) -> str:
    """Name plan length and duration where all cells share them."""
    shapes = {cell.setting[2:] for cell in cells}
    return "" if len(shapes) != 1 else ", N = {}, T_nom = {:g} s".format(*next(iter(shapes)))


def _promise(calibrations: Iterable[Mapping[str, Any]]) -> str:
    """Return what share of further plans calibration lets stall: that of epsilon, or less where plans are few."""
    worst = max(calibrations, key=lambda each: float(each["expected_risk"]))
    return (
        f"--guarantee {worst.get('guarantee', 'high-confidence')}: lambda lets at most {worst['expected_risk']:.2%} of "
        f"the plans stall on average, {worst['risk']:.2%} with {worst['confidence']:.1%} confidence "
        f"(--epsilon {worst['epsilon']:g})."
    )


ONLINE_LIVE = ("stream-to-act", "live")


def _plan_notes(run: Run, cells: Sequence[Timelines]) -> tuple[str, ...]:
    """Return how many plans there are, and what stream-to-act knew before them."""
    notes = []
    plans = {cell.n for cell in cells}
    if max(plans, default=1) > 1:
        moved = max(cell.values("rms_jerk").size for cell in cells)
        notes.append(f"{max(plans)} plans a cell, the same for every policy; motion: of the first {moved}.")
    if calibrations := run.manifest.get("calibrations"):
        cautions = [found["caution"] for found in calibrations.values() if found["caution"] is not None]
        span = " to ".join(f"{end:g}" for end in sorted({min(cautions), max(cautions)})) if cautions else "infinite"
        plans_each = next(iter(calibrations.values()))["plans"]
        kind = "recorded" if run.manifest["configuration"].get("calibrate") else "other"
        notes.append(f"stream-to-act: lambda {span}, calibrated on {plans_each} {kind} plans a setting.")
        notes.append(_promise(calibrations.values()))
    elif live_cautions := {cell.about("caution") for cell in cells if (cell.policy, cell.about("mode")) == ONLINE_LIVE}:
        span = ", ".join(f"{caution:g}" for caution in sorted(live_cautions))
        notes.append(f"stream-to-act: lambda {span}, not calibrated; its prior comes from the warm-ups, or the pace.")
    elif any((cell.policy, cell.about("mode")) == ("stream-to-act", "virtual") for cell in cells):
        notes.append("Nothing varies, and stream-to-act's prior knows it: online it starts at S0.")
    return tuple(notes)
