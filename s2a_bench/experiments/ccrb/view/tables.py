"""The tables of a CCRB run for people, and for programs as CSV."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.ccrb.view.outcomes import (
    SAID,
    Share,
    configuration,
    has,
    origin_notes,
    rate_span,
    rate_span_here,
    rollouts_of,
    scenes_of,
    share_of,
)
from s2a_bench.plan.skillset import GAPS
from s2a_bench.writers.csv_text import csv_text
from s2a_bench.writers.tables import ABSENT, TextTable, number

if TYPE_CHECKING:
    from s2a_bench.store.run import Run

ORDERINGS = {
    "paper": "the paper's ordering",
    "wait_worse": "wait worse than stream",
    "wait_better": "wait better",
    "naive_worse": "naive worse than stream",
    "naive_better": "naive better",
    "naive_rear_worse": "naive worse behind",
    "naive_rear_better": "naive better behind",
}


def outcome_table(run: Run) -> TextTable:
    """Lay out what became of the three cars under each policy."""
    rows = []
    for row in rollouts_of(run, "point").to_dict("records"):
        said = SAID[row["outcome"]] + (" (late)" if row["late"] is True else "")
        start, stall = (f"{row[name] / 1e9:.2f}" for name in ("start_ns", "stall_ns"))
        metrics = ("impact_speed_mps", "min_front_gap_m", "min_rear_gap_m")
        rows.append((row["policy"], said, start, str(row["stalls"]), stall, *(_entry(row[name]) for name in metrics)))
    asked = configuration(run)
    title = (
        f"CCRB with a car behind, {asked['simulator']} simulator: {asked['speed_kmh']:g} km/h, front gap "
        f"{asked['front_gap_m']:g} m, lead -{asked['lead_decel_mps2']:g} m/s\N{SUPERSCRIPT TWO}, rear gap "
        f"{asked['rear_gap_m']:g} m"
    )
    header = ("policy", "outcome", "start s", "stalls", "stalled s", "impact m/s", "front gap m", "rear gap m")
    return TextTable(title, header, rows, 2, notes=(*origin_notes(run), *_deadline_note(run)))


def margin_table(run: Run) -> TextTable:
    """Lay out how near an impact was, and how smoothly the ego drove."""
    rows = []
    for row in rollouts_of(run, "point").to_dict("records"):
        metrics = ("min_front_ttc_s", "min_rear_ttc_s", "required_decel_mps2", "rms_jerk", "peak_jerk")
        rows.append((row["policy"], *(_entry(row[name]) for name in metrics), _entry(row["sparc"])))
    notes = (
        "TTC: least time to collision. DRAC: greatest deceleration required towards the lead, closing^2 / (2 gap).",
        "Motion: the ego's simulated speed until it rests (with the jolt then) or hits the lead: a crash looks smooth.",
    )
    header = ("policy", "TTC front s", "TTC rear s", "DRAC m/s\N{SUPERSCRIPT TWO}", "RMS jerk", "peak jerk", "SPARC")
    return TextTable("Margins and motion", header, rows, 1, notes=notes)


def phase_table(run: Run) -> TextTable:
    """Lay out at which share of the diagram each ordering holds, a column a gap behaviour."""
    scenes = {gap: scenes_of(run, "phase", gap) for gap in GAPS}
    rows = [(said, *(f"{share_of(scenes[gap], name).value:.1%}" for gap in GAPS)) for name, said in ORDERINGS.items()]
    asked = configuration(run)
    rows.append(("R of the paper's ordering", *(_span(rate_span(run, gap)) for gap in GAPS)))
    rows.append((f"  at a rear gap of {asked['rear_gap_m']:g} m", *(_span(rate_span_here(run, gap)) for gap in GAPS)))
    (low, high), (near, far) = asked["phase_rates"], asked["phase_gaps_m"]
    title = (
        f"Phase diagram: R {low:g} to {high:g} tokens/s, rear gap {near:g} to {far:g} m, {asked['follower']} follower"
    )
    rules = frozenset({len(ORDERINGS)})
    return TextTable(title, ("share of the diagram", *GAPS), rows, 1, rules, _ordering_notes())


def random_table(run: Run) -> TextTable:
    """Lay out in which share of random scenarios each ordering holds, with its interval."""
    scenes = {gap: scenes_of(run, "random", gap) for gap in GAPS}
    rows = [(said, *(_with_interval(share_of(scenes[gap], name)) for gap in GAPS)) for name, said in ORDERINGS.items()]
    asked = configuration(run)
    title = f"{asked['random']} random scenarios: % [95 % Clopper-Pearson], {asked['follower']} follower"
    return TextTable(title, ("ordering", *GAPS), rows, 1, notes=_ordering_notes())


def ccrb_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name; what is compared comes last."""
    tables = {}
    if has(run, "random"):
        tables["random"] = random_table(run)
    if has(run, "phase"):
        tables["phase"] = phase_table(run)
    return {**tables, "margins": margin_table(run), "outcomes": outcome_table(run)}


def ccrb_csv(run: Run) -> dict[str, str]:
    """Return file name -> CSV text: the shares of the studies; the roll-outs are in rollouts.csv."""
    rows: list[tuple[Any, ...]] = []
    for study in ("phase", "random"):
        if has(run, study):
            for gap in GAPS:
                scenes = scenes_of(run, study, gap)
                for name in ORDERINGS:
                    share = share_of(scenes, name)
                    interval = share.interval if study == "random" else (None, None)
                    rows.append((study, gap, name, share.k, share.n, share.value, *interval))
    return {"orderings.csv": csv_text(("study", "gap_behaviour", "ordering", "k", "n", "share", "low", "high"), rows)}


def _ordering_notes() -> tuple[str, ...]:
    return (
        "The paper's ordering: naive hit from behind, wait-then-act hits the lead, stream-to-act nobody.",
        "Worse, better: than stream-to-act, by an impact more than 0.5 m/s faster or slower; behind: from there alone.",
    )


def _deadline_note(run: Run) -> tuple[str, ...]:
    """Say by when a stall-free start is early enough."""
    deadline_s = float(rollouts_of(run, "point")["deadline_ns"].iloc[0]) / 1e9
    return (f"S_front = {deadline_s:.2f} s: who brakes as planned from then on keeps 2 m to the lead.",)


def _entry(value: Any) -> str:
    """Write a number that may be missing."""
    import pandas as pd

    return ABSENT if pd.isna(value) else number(value)


def _span(found: tuple[float, float] | None) -> str:
    return f"{found[0]:.1f}\N{EN DASH}{found[1]:.1f}" if found else ABSENT


def _with_interval(share: Share) -> str:
    low, high = share.interval
    return f"{100 * share.value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
