"""The sentences, tables, CSV and JSON of a CCRB run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments import Shown, requests
from s2a_bench.experiments.ccrb.rows import METRICS, RolloutRow
from s2a_bench.experiments.ccrb.view.figures import ccrb_figures
from s2a_bench.experiments.ccrb.view.outcomes import (
    Share,
    cells_of,
    configuration,
    has,
    origin_notes,
    rate_span,
    request_of,
    rollouts_of,
    scenes_of,
    share_of,
    tokens_line,
)
from s2a_bench.experiments.cells import TIME, Metric
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.labels import NO_SCORE, ORDERING, law, operating_point, outcome_label
from s2a_bench.store.schema import Positive
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.json import cell_of_row, frame
from s2a_bench.writers.tables import ABSENT, PAPERS, Note, TextTable, entries, number

if TYPE_CHECKING:
    from collections.abc import Callable

    from s2a_bench.store.run import StoredRun


def show(run: StoredRun, **_: Any) -> Shown:
    return Shown.build(
        sentences=lambda: _ccrb_sentences(run),
        tables={
            "random": lambda: _random_table(run) if has(run, "random") else None,
            "phase": lambda: _phase_table(run) if has(run, "phase") else None,
            "margins": lambda: _margin_table(run),
            "stages": lambda: _stage_table(run) if "live" in run.manifest and has(run, "rollout") else None,
            "outcomes": lambda: _outcome_table(run),
        },
        main=["outcomes", "stages", "phase", "random"],
        csvs=lambda: _ccrb_csv(run),
        figures=lambda: ccrb_figures(run),
        json=lambda: ccrb_json(run),
    )


def _ccrb_sentences(run: StoredRun) -> list[str]:
    sentences = [
        f"{cell['policy']}: {outcome_label(cell['outcome'], cell['follower_survives'])}, "
        f"{cell['stalls']} stalls of {cell['stall_s']:.2f} s."
        for cell in cells_of(run)
    ]
    if has(run, "phase"):
        sentences += [f"Phase diagram, gap behaviour {finding(run, gap)}" for gap in GAPS]
    if studies := run.manifest.get("studies"):
        speed = studies["rollouts_per_cpu_s"]
        sentences.append(f"{studies['rollouts']} roll-outs, {speed:.0f} a second of processor time.")
    return sentences


def finding(run: StoredRun, gap: str) -> str:
    share = share_of(scenes_of(run, "phase", gap), "paper")
    sentence = f"{gap}: the paper's ordering holds at {share.value:.1%} of the diagram"
    span, at_point = rate_span(run, gap), rate_span(run, gap, at_point=True)
    if span is None:
        return f"{gap}: the paper's ordering holds nowhere in the diagram."
    at = f"at a rear gap of {configuration(run)['rear_gap_m']:g} m"
    where = f"{at} for {at_point[0]:.1f} to {at_point[1]:.1f}" if at_point else f"{at} nowhere"
    return f"{sentence}, for R = {span[0]:.1f} to {span[1]:.1f} tokens/s; {where}."


TIMES: Final = ("start_s", "stalls", "stall_s")
IMPACTS: Final = ("impact_speed_mps", "min_front_gap_m", "min_rear_gap_m")
MARGINS: Final = ("min_front_ttc_s", "min_rear_ttc_s", "required_decel_mps2")
MOTION: Final = ("rms_jerk", "peak_jerk", "sparc")
LOOP: Final = ("real_time_factor", "tracking_rms_mps")

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

_TIMES: Final = [metric for metric in METRICS.values() if metric.kind == TIME]
CcrbCell = cell_of_row(
    "CcrbCell",
    "A policy at the operating point.",
    RolloutRow,
    without=("draw", "board", "title", "tokens_per_s", *(metric.column for metric in _TIMES)),
    own={
        "profile": str | None,
        "rate_tokens_per_s": Positive,
        **{metric.name: float for metric in _TIMES},
    },
)


def _outcome_table(run: StoredRun) -> TextTable:
    names = (*TIMES, *IMPACTS, *(LOOP if has(run, "rollout") else ()))
    rows, shown = [], [METRICS[name] for name in names]
    for cell in cells_of(run, ("point", "rollout")):
        outcome = outcome_label(cell["outcome"], cell["follower_survives"]) + (" (late)" if cell.get("late") else "")
        name = cell["policy"] if cell["study"] == "point" else "  roll-out"
        rows.append((name, outcome, *(_entry(cell, metric) for metric in shown)))
    settings = configuration(run)
    title = f"CCRB with a car behind, {settings['simulator']} simulator: {operating_point(settings)}"
    header = ("policy", "outcome", *map(_title, shown))
    deadline_s = float(rollouts_of(run, "point")["deadline_ns"].iloc[0]) / 1e9
    deadline = f"S_front = {deadline_s:.2f} s: planned braking that starts by then keeps 2 m to the lead."
    return TextTable(title, header, rows, 2, notes=(*origin_notes(run), deadline, NO_SCORE))


def _stage_table(run: StoredRun) -> TextTable:
    cells = requests.cells_of(run)
    (cell,) = cells
    metrics = (*(f"{requests.GROUP}{group}" for group in cells.groups), "residual", "ttft", "e2e")
    rows = []
    for policy in cells_of(run):
        mine = cell.of_requests(cell.counted[cell.ids == request_of(run, policy["cell"])])
        rows.append((policy["policy"], *(entries(mine.values(metric), "median")[0] for metric in metrics)))
    title, header = (
        "Each policy's request in ms, to its first token",
        ("policy", *cells.groups, "residual", "TTFT", "e2e"),
    )
    return TextTable(title, header, rows, 1, notes=(tokens_line(run), "TTFT: from the prompt; e2e: with the capture."))


def _margin_table(run: StoredRun) -> TextTable:
    rows = [(cell["policy"], *(_entry(cell, METRICS[name]) for name in (*MARGINS, *MOTION))) for cell in cells_of(run)]
    notes = (
        "TTC: least time to collision. DRAC: greatest deceleration required towards the lead, closing^2 / (2 gap).",
        "Motion: the ego's simulated speed until it rests (with the jolt then) or hits the lead: a crash looks smooth.",
    )
    return TextTable(
        "Margins and motion", ("policy", *(_title(METRICS[name]) for name in (*MARGINS, *MOTION))), rows, 1, notes=notes
    )


def _phase_table(run: StoredRun) -> TextTable:
    rows = _share_rows(run, "phase", lambda share: f"{share.value:.1%}")
    settings = configuration(run)
    rows.append(("R of the paper's ordering", *(_span(rate_span(run, gap)) for gap in GAPS)))
    at_point = (_span(rate_span(run, gap, at_point=True)) for gap in GAPS)
    rows.append((f"  at a rear gap of {settings['rear_gap_m']:g} m", *at_point))
    (low, high), (near, far) = settings["phase_rates"], settings["phase_gaps_m"]
    spans = f"R {low:g} to {high:g} tokens/s, rear gap {near:g} to {far:g} m"
    title = f"Phase diagram: {spans}, {settings['follower']} follower"
    rules = frozenset({len(rows) - 2})
    return TextTable(title, ("share of the diagram", *GAPS), rows, 1, rules, _ORDERING_NOTES)


def _random_table(run: StoredRun) -> TextTable:
    settings = configuration(run)
    title = f"{settings['random']} random scenarios: % [95 % Clopper-Pearson], {settings['follower']} follower"
    return TextTable(title, ("ordering", *GAPS), _share_rows(run, "random", _with_interval), 1, notes=_ORDERING_NOTES)


def _share_rows(run: StoredRun, study: str, written: Callable[[Share], str]) -> list[tuple[str, ...]]:
    scenes = {gap: scenes_of(run, study, gap) for gap in GAPS}
    checked = all(found["survives"].notna().all() for found in scenes.values())
    counted = {**ORDERINGS, **({"survives": "follower survives fast tokens"} if checked else {})}
    return [(text, *(written(share_of(scenes[gap], name)) for gap in GAPS)) for name, text in counted.items()]


def _ccrb_csv(run: StoredRun) -> dict[str, CsvTable]:
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


def ccrb_json(run: StoredRun) -> dict[str, Any]:
    """Return the ``--json`` object (docs/schema/s2a-bench-1.json): SI units, a cell a policy, studies as shares."""
    studies = [_study(run, study, gap) for study in ("phase", "random") if has(run, study) for gap in GAPS]
    live = {"live": run.manifest["live"]} if "live" in run.manifest else {}
    beside = {"rollouts": cells_of(run, ("rollout",))} if has(run, "rollout") else {}
    return frame(run, cells_of(run), [], **live, **beside, follower_law=law(configuration(run)), studies=studies)


def _study(run: StoredRun, study: str, gap: str) -> dict[str, Any]:
    scenes = scenes_of(run, study, gap)
    found = {name: share_of(scenes, name) for name in ORDERINGS}
    shares = {
        name: {"k": share.k, "value": share.value, **({"ci95": list(share.interval)} if study == "random" else {})}
        for name, share in found.items()
    }
    check = {}
    if scenes["survives"].notna().all():
        survives = share_of(scenes, "survives")
        check = {"follower_survives": {"k": survives.k, "value": survives.value}}
    span = rate_span(run, gap) if study == "phase" else None
    rates = {} if span is None else {"paper_rates_tokens_per_s": list(span)}
    return {"study": study, "gap_behaviour": gap, "scenarios": len(scenes), "orderings": shares, **check, **rates}


def _title(metric: Metric) -> str:
    return f"{metric.title} {metric.unit}".strip()


def _entry(cell: dict[str, Any], metric: Metric) -> str:
    value = cell.get(metric.name)
    if value is None:
        return ABSENT
    return str(value) if isinstance(value, int) else number(value)


def _span(found: tuple[float, float] | None) -> str:
    return f"{found[0]:.1f}\N{EN DASH}{found[1]:.1f}" if found else ABSENT


def _with_interval(share: Share) -> str:
    low, high = share.interval
    return f"{100 * share.value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
