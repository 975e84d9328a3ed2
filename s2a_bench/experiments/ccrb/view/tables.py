"""The tables of a CCRB run for people, and for programs as CSV and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.ccrb.metrics import MARGINS, OUTCOMES
from s2a_bench.experiments.ccrb.rows import FOLLOWER_STUDY, SENSITIVITY
from s2a_bench.experiments.ccrb.view.cell import ORDERINGS
from s2a_bench.experiments.ccrb.view.outcomes import (
    Share,
    cells_of,
    configuration,
    has,
    rate_span,
    rate_span_here,
    rollouts_of,
    scenes_of,
    share_of,
)
from s2a_bench.experiments.ccrb.view.sentences import origin_notes
from s2a_bench.experiments.ccrb.view.variations import follower_tables
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.words import NO_SCORE, ORDERING, law, operating_point, said
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.as_json import frame
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.tables import ABSENT, PAPERS, Note, TextTable, number

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pandas as pd

    from s2a_bench.experiments import Metric
    from s2a_bench.store.run import Run
    from s2a_bench.store.schema import Table


def outcome_table(run: Run) -> TextTable:
    """Lay out what became of the three cars under each policy."""
    rows = []
    for cell in cells_of(run):
        outcome = said(cell["outcome"], cell.get("follower_survives", True)) + (" (late)" if cell.get("late") else "")
        rows.append((cell["policy"], outcome, *(_entry(cell, metric) for metric in OUTCOMES)))
    asked = configuration(run)
    title = f"CCRB with a car behind, {asked['simulator']} simulator: {operating_point(asked)}"
    header = ("policy", "outcome", *map(_title, OUTCOMES))
    return TextTable(title, header, rows, 2, notes=(*origin_notes(run), *_deadline_note(run), NO_SCORE))


def margin_table(run: Run) -> TextTable:
    """Lay out how near an impact was, and how smoothly the ego drove."""
    rows = [(cell["policy"], *(_entry(cell, metric) for metric in MARGINS)) for cell in cells_of(run)]
    notes = (
        "TTC: least time to collision. DRAC: greatest deceleration required towards the lead, closing^2 / (2 gap).",
        "Motion: the ego's simulated speed until it rests (with the jolt then) or hits the lead: a crash looks smooth.",
    )
    return TextTable("Margins and motion", ("policy", *map(_title, MARGINS)), rows, 1, notes=notes)


def phase_table(run: Run) -> TextTable:
    """Lay out at which share of the diagram each ordering holds, a column a gap behaviour."""
    scenes = {gap: scenes_of(run, "phase", gap) for gap in GAPS}
    rows = [
        (text, *(f"{share_of(scenes[gap], name).value:.1%}" for gap in GAPS))
        for name, text in _shares(scenes.values()).items()
    ]
    asked = configuration(run)
    rows.append(("R of the paper's ordering", *(_span(rate_span(run, gap)) for gap in GAPS)))
    rows.append((f"  at a rear gap of {asked['rear_gap_m']:g} m", *(_span(rate_span_here(run, gap)) for gap in GAPS)))
    (low, high), (near, far) = asked["phase_rates"], asked["phase_gaps_m"]
    title = (
        f"Phase diagram: R {low:g} to {high:g} tokens/s, rear gap {near:g} to {far:g} m, {asked['follower']} follower"
    )
    rules = frozenset({len(rows) - 2})
    return TextTable(title, ("share of the diagram", *GAPS), rows, 1, rules, _ordering_notes())


def random_table(run: Run) -> TextTable:
    """Lay out in which share of random scenarios each ordering holds, with its interval."""
    scenes = {gap: scenes_of(run, "random", gap) for gap in GAPS}
    rows = [
        (text, *(_with_interval(share_of(scenes[gap], name)) for gap in GAPS))
        for name, text in _shares(scenes.values()).items()
    ]
    asked = configuration(run)
    title = f"{asked['random']} random scenarios: % [95 % Clopper-Pearson], {asked['follower']} follower"
    return TextTable(title, ("ordering", *GAPS), rows, 1, notes=_ordering_notes())


def _shares(scenes: Iterable[pd.DataFrame]) -> dict[str, str]:
    """Return what is counted: the orderings, and the check on the car behind where the run has it."""
    checked = all(found["survives"].notna().all() for found in scenes)
    return {**ORDERINGS, **({"survives": "follower survives fast tokens"} if checked else {})}


def ccrb_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name; what is compared comes last."""
    tables = {}
    if has(run, "random"):
        tables["random"] = random_table(run)
    if has(run, "phase"):
        tables["phase"] = phase_table(run)
    if len(run.table(FOLLOWER_STUDY)):
        tables |= follower_tables(run)
    return {**tables, "margins": margin_table(run), "outcomes": outcome_table(run)}


def ccrb_csv(run: Run) -> dict[str, CsvTable]:
    """Return file name -> CSV table: the shares of the studies; the roll-outs are in rollouts.csv."""
    rows: list[tuple[Any, ...]] = []
    for study in ("phase", "random"):
        if has(run, study):
            for gap in GAPS:
                scenes = scenes_of(run, study, gap)
                for name in ORDERINGS:
                    share = share_of(scenes, name)
                    interval = share.interval if study == "random" else (None, None)
                    rows.append((study, gap, name, share.k, share.n, share.value, *interval))
    return {
        "orderings.csv": CsvTable.of(("study", "gap_behaviour", "ordering", "k", "n", "share", "low", "high"), rows)
    }


def ccrb_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints, as docs/schema/s2a-bench-1.json describes it; SI units, float seconds.

    A cell a policy at the operating point; studies are summed up as shares, their roll-outs are in the run folder.
    """
    studies = [_study(run, study, gap) for study in ("phase", "random") if has(run, study) for gap in GAPS]
    live = {"live": run.manifest["live"]} if "live" in run.manifest else {}
    varied = {"followers": _counts(run, FOLLOWER_STUDY), "sensitivity": _counts(run, SENSITIVITY)}
    more = {name: rows for name, rows in varied.items() if rows}
    return frame(run, cells_of(run), [], **live, follower_law=law(configuration(run)), studies=studies, **more)


def _counts(run: Run, table: Table[Any]) -> list[dict[str, Any]]:
    """Return the rows of a study that counts; what one lacks is no key."""
    rows = run.table(table).drop(columns=["cell", PROVENANCE])
    return [{str(name): value for name, value in row.dropna().items()} for _, row in rows.astype(object).iterrows()]


def _study(run: Run, study: str, gap: str) -> dict[str, Any]:
    """Return the shares of one study under one gap behaviour."""
    scenes = scenes_of(run, study, gap)
    shares = {}
    for name in ORDERINGS:
        share = share_of(scenes, name)
        interval = {"ci95": list(share.interval)} if study == "random" else {}
        shares[name] = {"k": share.k, "value": share.value, **interval}
    check = {}
    if scenes["survives"].notna().all():
        survives = share_of(scenes, "survives")
        check = {"follower_survives": {"k": survives.k, "value": survives.value}}
    span = rate_span(run, gap) if study == "phase" else None
    rates = {} if span is None else {"paper_rates_tokens_per_s": list(span)}
    return {"study": study, "gap_behaviour": gap, "scenarios": len(scenes), "orderings": shares, **check, **rates}


def _ordering_notes() -> tuple[str, ...]:
    return (
        Note(ORDERING, PAPERS),
        "Worse, better: than stream-to-act, by an impact more than 0.5 m/s faster or slower; behind: from there alone.",
        "Where the follower hits even an ego whose tokens come at once, a rear impact says nothing of the policy.",
    )


def _deadline_note(run: Run) -> tuple[str, ...]:
    """Say by when a stall-free start is early enough."""
    deadline_s = float(rollouts_of(run, "point")["deadline_ns"].iloc[0]) / 1e9
    return (f"S_front = {deadline_s:.2f} s: who brakes as planned from then on keeps 2 m to the lead.",)


def _title(metric: Metric) -> str:
    return f"{metric.title} {metric.unit}".strip()


def _entry(cell: dict[str, Any], metric: Metric) -> str:
    """Return a metric of a cell as text."""
    value = cell.get(metric.name)
    if value is None:
        return ABSENT
    return str(value) if isinstance(value, int) else number(value)


def _span(found: tuple[float, float] | None) -> str:
    return f"{found[0]:.1f}\N{EN DASH}{found[1]:.1f}" if found else ABSENT


def _with_interval(share: Share) -> str:
    low, high = share.interval
    return f"{100 * share.value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
