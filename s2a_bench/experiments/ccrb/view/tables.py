"""The sentences, tables, CSV and JSON of a CCRB run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import pandas as pd

from s2a_bench.experiments import Shown, requests
from s2a_bench.experiments.ccrb.rows import METRICS, RolloutRow
from s2a_bench.experiments.ccrb.view.figures import ccrb_figures
from s2a_bench.experiments.ccrb.view.outcomes import Rollouts, Share, origin_notes, rate_span, share_of, tokens_line
from s2a_bench.experiments.cells import json_of
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.labels import NO_SCORE, ORDERING, law, operating_point
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ABSENT, PAPERS, Note, TextTable, entries, number

OUTCOME: Final = ("start_s", "stalls", "stall_s", "impact_speed_mps", "min_front_gap_m", "min_rear_gap_m")
LOOP: Final = ("real_time_factor", "tracking_rms_mps")
MARGINS: Final = ("min_front_ttc_s", "min_rear_ttc_s", "required_decel_mps2", "rms_jerk", "peak_jerk", "sparc")

ORDERINGS: Final = {
    "paper": "the paper's ordering",
    "wait_worse": "wait worse than stream",
    "wait_better": "wait better",
    "naive_worse": "naive worse than stream",
    "naive_better": "naive better",
    "naive_rear_worse": "naive worse behind",
    "naive_rear_better": "naive better behind",
}

_ORDERING_NOTES: Final = (
    Note(ORDERING, PAPERS),
    "Worse, better: an impact more than 0.5 m/s faster or slower than stream-to-act's; behind: rear impacts alone.",
    "Where the follower hits even an ego with immediate tokens, a rear impact says nothing about the policy.",
)


def show(run: StoredRun, **_: Any) -> Shown:
    rollouts = Rollouts.of(run)
    return Shown.build(
        sentences=partial(_sentences, rollouts),
        tables={
            "outcomes": partial(_outcome_table, rollouts),
            "stages": partial(_stage_table, rollouts),
            "phase": partial(_phase_table, rollouts),
            "random": partial(_random_table, rollouts),
            "margins": lambda: _margin_table(rollouts.point),
        },
        main=["outcomes", "stages", "phase", "random"],
        csvs=lambda: {"orderings.csv": _ordering_csv(rollouts.studies)},
        figures=partial(ccrb_figures, rollouts),
        json=partial(_json, rollouts),
    )


def _sentences(rollouts: Rollouts) -> list[str]:
    sentences = [
        f"{row.policy}: {row.label}, {row.stalls} stalls of {row.stall_ns / 1e9:.2f} s." for row in rollouts.point
    ]
    for gap, scenes in rollouts.studies.get("phase", {}).items():
        sentences.append(f"Phase diagram, gap behaviour {finding(gap, scenes, rollouts.settings['rear_gap_m'])}")
    return sentences


def finding(gap: str, scenes: pd.DataFrame, rear_gap_m: float) -> str:
    """Return where the paper's ordering holds in the phase diagram of a gap behaviour, and at a rear gap."""
    span, at_point = rate_span(scenes), rate_span(scenes, rear_gap_m)
    if span is None:
        return f"{gap}: the paper's ordering holds nowhere in the diagram."
    sentence = f"{gap}: the paper's ordering holds at {share_of(scenes, 'paper').value:.1%} of the diagram"
    where = f"for {at_point[0]:.1f} to {at_point[1]:.1f}" if at_point else "nowhere"
    return f"{sentence}, for R = {span[0]:.1f} to {span[1]:.1f} tokens/s; at a rear gap of {rear_gap_m:g} m {where}."


def _outcome_table(rollouts: Rollouts) -> TextTable:
    """Return a line a policy, each closed loop with its roll-out below it."""
    rows: list[tuple[str, ...]] = []
    names = (*OUTCOME, *LOOP) if rollouts.beside else OUTCOME
    for row in rollouts.point:
        rows.append((row.policy, row.label, *_entries(row, names)))
        if beside := rollouts.beside.get(row.cell):
            rows.append(("  roll-out", beside.label, *_entries(beside, names)))
    settings, deadline_s = rollouts.settings, rollouts.point[0].deadline_ns / 1e9
    title = f"CCRB with a car behind, {settings['simulator']} simulator: {operating_point(settings)}"
    deadline = f"S_front = {deadline_s:.2f} s: planned braking that starts by then keeps 2 m to the lead."
    notes = (*origin_notes(rollouts), deadline, NO_SCORE)
    return TextTable(title, ("policy", "outcome", *_titles(names)), rows, 2, notes=notes)


def _stage_table(rollouts: Rollouts) -> TextTable | None:
    """Return the stages of each closed loop's request to a model; None without such requests."""
    if not (rollouts.live and rollouts.beside):
        return None
    cells = requests.cells_of(rollouts.run)
    (cell,) = cells
    metrics, rows = (*(f"{requests.GROUP}{group}" for group in cells.groups), "residual", "ttft", "e2e"), []
    for policy in rollouts.point:
        mine = replace(cell, requests=cell.counted[cell.ids == rollouts.request_of(policy.cell)])
        rows.append((policy.policy, *(entries(mine.values(metric), "median")[0] for metric in metrics)))
    title = "Each policy's request in ms, to its first token"
    header = ("policy", *cells.groups, "residual", "TTFT", "e2e")
    notes = (tokens_line(rollouts.run), "TTFT: from the prompt; e2e: with the capture.")
    return TextTable(title, header, rows, 1, notes=notes)


def _margin_table(point: list[RolloutRow]) -> TextTable:
    rows = [(row.policy, *_entries(row, MARGINS)) for row in point]
    notes = (
        "TTC: least time to collision. DRAC: greatest deceleration required towards the lead, closing^2 / (2 gap).",
        "Motion: the ego's simulated speed until it rests (with the jolt then) or hits the lead: a crash looks smooth.",
    )
    return TextTable("Margins and motion", ("policy", *_titles(MARGINS)), rows, 1, notes=notes)


def _phase_table(rollouts: Rollouts) -> TextTable | None:
    if (diagram := rollouts.studies.get("phase")) is None:
        return None
    settings, rows = rollouts.settings, _share_rows(diagram, lambda share: f"{share.value:.1%}")
    rear_gap_m = settings["rear_gap_m"]
    rows.append(("R of the paper's ordering", *(_span(scenes) for scenes in diagram.values())))
    rows.append((f"  at a rear gap of {rear_gap_m:g} m", *(_span(scenes, rear_gap_m) for scenes in diagram.values())))
    (low, high), (near, far) = settings["phase_rates"], settings["phase_gaps_m"]
    spans = f"R {low:g} to {high:g} tokens/s, rear gap {near:g} to {far:g} m"
    title = f"Phase diagram: {spans}, {settings['follower']} follower"
    rules = frozenset({len(rows) - 2})
    return TextTable(title, ("share of the diagram", *GAPS), rows, 1, rules, _ORDERING_NOTES)


def _random_table(rollouts: Rollouts) -> TextTable | None:
    if (drawn := rollouts.studies.get("random")) is None:
        return None
    settings = rollouts.settings
    title = f"{settings['random']} random scenarios: % [95 % Clopper-Pearson], {settings['follower']} follower"
    return TextTable(title, ("ordering", *GAPS), _share_rows(drawn, _with_interval), 1, notes=_ORDERING_NOTES)


def _share_rows(study: Mapping[str, pd.DataFrame], written: Callable[[Share], str]) -> list[tuple[str, ...]]:
    counted = dict(ORDERINGS)
    if all(scenes["survives"].notna().all() for scenes in study.values()):
        counted["survives"] = "follower survives fast tokens"
    return [(text, *(written(share_of(scenes, name)) for scenes in study.values())) for name, text in counted.items()]


def _ordering_csv(studies: Mapping[str, Mapping[str, pd.DataFrame]]) -> CsvTable:
    rows: list[tuple[Any, ...]] = []
    for study, by_gap in studies.items():
        for gap, scenes in by_gap.items():
            for name in ORDERINGS:
                share = share_of(scenes, name)
                low, high = share.interval if study == "random" else (None, None)
                rows.append((study, gap, name, share.k, share.n, share.value, low, high))
    return CsvTable.of(("study", "gap_behaviour", "ordering", "k", "n", "share", "low", "high"), rows)


def _json(rollouts: Rollouts) -> dict[str, Any]:
    """Return the ``--json`` object (docs/schema/s2a-bench-1.json): SI units, a cell a policy, studies as shares."""
    more: dict[str, Any] = {"live": rollouts.live} if rollouts.live else {}
    if rollouts.beside:
        more["rollouts"] = [json_of(row) for row in rollouts.beside.values()]
    studies = [
        _study_json(study, gap, scenes) for study, by_gap in rollouts.studies.items() for gap, scenes in by_gap.items()
    ]
    cells = [json_of(row) for row in rollouts.point]
    return frame(rollouts.run, cells, [], **more, follower_law=law(rollouts.settings), studies=studies)


def _study_json(study: str, gap: str, scenes: pd.DataFrame) -> dict[str, Any]:
    shares = {name: _share_json(share_of(scenes, name), interval=study == "random") for name in ORDERINGS}
    entry = {"study": study, "gap_behaviour": gap, "scenarios": len(scenes), "orderings": shares}
    if scenes["survives"].notna().all():
        entry["follower_survives"] = _share_json(share_of(scenes, "survives"))
    if study == "phase" and (span := rate_span(scenes)):
        entry["paper_rates_tokens_per_s"] = list(span)
    return entry


def _share_json(share: Share, *, interval: bool = False) -> dict[str, Any]:
    entry: dict[str, Any] = {"k": share.k, "value": share.value}
    return {**entry, "ci95": list(share.interval)} if interval else entry


def _titles(metrics: Sequence[str]) -> list[str]:
    return [f"{METRICS[name].title} {METRICS[name].unit}".strip() for name in metrics]


def _entries(row: RolloutRow, metrics: Sequence[str]) -> list[str]:
    return [_entry(METRICS[name].read(row)) for name in metrics]


def _entry(value: float | None) -> str:
    if value is None:
        return ABSENT
    return str(value) if isinstance(value, int) else number(value)


def _span(scenes: pd.DataFrame, rear_gap_m: float | None = None) -> str:
    span = rate_span(scenes, rear_gap_m)
    return f"{span[0]:.1f}\N{EN DASH}{span[1]:.1f}" if span else ABSENT


def _with_interval(share: Share) -> str:
    low, high = share.interval
    return f"{100 * share.value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
