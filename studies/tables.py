"""What the studies of the policies come to: targets met or not, frontiers, drift, and wrong beliefs, as tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.writers.tables import ABSENT, DRAWN, Note, TextTable
from studies.rows import STUDY_CELLS
from studies.targets import ONLINE, targets_of
from studies.worlds import HARD

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import StoredRun

LEVELS: Final = (0.01, 0.05, 0.20)
"""Shares of stalled plans at which a frontier's regret is read off."""
WORLD: Final = ["tokens_per_s", "tokens_per_skill", "n_skills", "t_nom_s"]
DRAWN_PLANS: Final = "Plans are drawn from models of the arrivals; nothing here is measured."


def regret_at(points: pd.DataFrame, level: float, what: str = "start_regret") -> float:
    """Return the least regret on one frontier (a world, family and policy) with P(any stall) <= ``level``.

    Interpolates between values of lambda. A level beyond the frontier's end at lambda = 0 costs what that end costs.
    """
    import numpy as np

    ordered = points.sort_values(["p_any_stall", what])
    cheapest = np.minimum.accumulate(ordered[what].to_numpy(dtype=float))
    return float(np.interp(level, ordered["p_any_stall"].to_numpy(dtype=float), cheapest))


def rows_of(run: StoredRun) -> pd.DataFrame:
    """Return the rows of a study."""
    return run.table(STUDY_CELLS)


def first_seed(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the first seed."""
    first: pd.DataFrame = rows[rows["seed"] == rows["seed"].iloc[0]]
    return first


def over_seeds(rows: pd.DataFrame, statistic: Callable[[pd.DataFrame], float], form: str = "{:.1%}") -> str:
    """Write a number's mean over the seeds, with the range in brackets where there are several."""
    import numpy as np

    values = np.array([statistic(part) for _, part in rows.groupby("seed")], dtype=float)
    if np.isnan(values).all():
        return ABSENT
    mean = form.format(np.nanmean(values))
    if values.size == 1:
        return mean
    low, high = (form.format(end).removesuffix("%") for end in (np.nanmin(values), np.nanmax(values)))
    return f"{mean} [{low}, {high}]"


def mean_of(column: str) -> Callable[[pd.DataFrame], float]:
    """Return what takes the mean of a column."""
    return lambda rows: float(rows[column].astype("float64").mean())


def target_tables(rows: pd.DataFrame) -> Iterator[TextTable]:
    """Show the targets, the policies side by side, and where the online rule has it hardest."""
    online = rows[rows["policy"] == ONLINE]
    by_seed = [targets_of(part) for _, part in rows.groupby("seed")]
    lines: list[tuple[str, ...]] = [
        (
            each[0].what,
            over_seeds(rows, lambda part, place=place: targets_of(part)[place].value, "{:.2%}"),  # type: ignore[misc]
            f"{each[0].limit:.0%}",
            "met" if all(target.met for target in each) else "MISSED",
        )
        for place, each in enumerate(zip(*by_seed, strict=True))
    ]
    settings = f"{len(first_seed(online))} settings{seeds(rows)}"
    note = Note(f"{settings}, {int(online['plans'].sum()):,} plans. {DRAWN_PLANS}", DRAWN)
    yield TextTable(f"Targets of {ONLINE}", ("", "reached", "wanted", ""), lines, 1, notes=(note,))
    columns = {
        "P(stall)": "p_any_stall",
        "start": "start_regret",
        "signed": "signed_start_regret",
        "of wait": "start_regret_of_wait",
        "over S_lo": "start_regret_elastic",
        "end": "end_regret",
        "end of wait": "end_regret_of_wait",
        "over E_lo": "end_regret_elastic",
    }
    parts = {"all": rows, "rho > .8": rows[rows["rho"] > HARD]}
    lines = [
        (str(policy), scope, *(over_seeds(each, mean_of(column), "{:.2%}") for column in columns.values()))
        for policy in rows["policy"].unique()
        for scope, part in parts.items()
        for each in (part[part["policy"] == policy],)
    ]
    notes = (
        "Means over settings. start: max(0, s_1 - S0) / S0; signed: with its sign; end: (e_N - E) / E, E = S0 + P_N.",
        "of wait: over t_N - S0, which a long time to first token does not flatter.",
        "S0: the clairvoyant start at nominal durations. S_lo, E_lo: the least start and end when skills may stretch.",
    )
    yield TextTable("Policies", ("policy", "settings", *columns), lines, 2, notes=notes)
    worst = online.sort_values("p_any_stall", ascending=False).head(5)
    header = ("R", "L", "N", "T", "rho", "lambda", "P(stall)", "start", "end")
    lines = [
        (*_world(row), _caution(row), *(f"{row[name]:.2%}" for name in ("p_any_stall", "start_regret", "end_regret")))
        for _, row in worst.iterrows()
    ]
    yield TextTable("Most stalls", header, lines, 0)


def frontier_tables(rows: pd.DataFrame) -> Iterator[TextTable]:
    """Show what each share of stalls costs."""
    header = ("R", "L", "N", "T", "rho", "gaps", "policy", *(f"at {level:.0%}" for level in LEVELS))
    lines = [
        (
            *_world(points.iloc[0]),
            str(points["family"].iloc[0]),
            str(points["policy"].iloc[0]),
            *(over_seeds(points, partial(regret_at, level=level), "{:+.0%}") for level in LEVELS),
        )
        for _, points in rows[rows["condition"] == ""].groupby([*WORLD, "family", "policy"], sort=False)
    ]
    notes = (Note(f"Start regret over S0 where that share of the plans stalls{seeds(rows)}. {DRAWN_PLANS}", DRAWN),)
    yield TextTable("Frontier: what rare stalls cost", header, lines, 7, notes=notes)
    yield _guarantees(rows)


def _guarantees(rows: pd.DataFrame) -> TextTable:
    """Show what each guarantee delivers and costs."""
    calibrated = rows[rows["condition"] != ""]
    header = ("R", "L", "N", "T", "rho", "gaps", "guarantee", "P(stall)", "late start", "over S_lo")
    lines = [
        (
            *_world(points.iloc[0]),
            str(points["family"].iloc[0]),
            "expected" if "expected" in str(points["condition"].iloc[0]) else "high-confidence",
            over_seeds(points, mean_of("p_any_stall"), "{:.2%}"),
            over_seeds(points, mean_of("start_regret"), "{:.0%}"),
            over_seeds(points, mean_of("start_regret_elastic"), "{:.0%}"),
        )
        for _, points in calibrated.groupby([*WORLD, "family", "condition"], sort=False)
    ]
    plans = int(rows["calibration_plans"].max())
    notes = (
        f"lambda as --guarantee makes calibration on {plans} plans choose it{seeds(rows)}.",
        "late start, over S_lo: start regret over S0 and over S_lo.",
    )
    return TextTable("What epsilon buys", header, lines, 7, notes=notes)


def drift_tables(rows: pd.DataFrame) -> Iterator[TextTable]:
    """Show P(any stall) block by block."""
    blocks = sorted(int(block) for block in rows["block"].unique())
    header = ("R", "L", "N", "T", "rho", "drift", *(str(block + 1) for block in blocks), "late start")
    lines = [
        (
            *_world(points.iloc[0]),
            str(points["condition"].iloc[0]),
            *(over_seeds(points[points["block"] == block], mean_of("p_any_stall")) for block in blocks),
            over_seeds(points, mean_of("start_regret"), "{:.0%}"),
        )
        for _, points in rows.groupby([*WORLD, "condition"], sort=False)
    ]
    notes = (
        "P(any stall) in one stretch of plans after the other; the drift begins with the third of eight.",
        Note(f"late start: mean start regret over S0. {DRAWN_PLANS}", DRAWN),
    )
    yield TextTable("Drift", header, lines, 6, notes=notes)


def misfit_tables(rows: pd.DataFrame) -> Iterator[TextTable]:
    """Show what each wrong belief costs."""
    header = ("R", "L", "N", "T", "rho", "believed", "lambda", "P(stall)", "start", "signed", "end")
    names = ("p_any_stall", "start_regret", "signed_start_regret", "end_regret")
    lines = [
        (
            *_world(points.iloc[0]),
            str(points["condition"].iloc[0]),
            _caution(points.iloc[0]) if len(points) == 1 else ABSENT,
            *(over_seeds(points, mean_of(name)) for name in names),
        )
        for _, points in rows.groupby([*WORLD, "condition"], sort=False)
    ]
    yield TextTable(
        "Wrong beliefs", header, lines, 6, notes=(Note(f"Calibrated with the right ones. {DRAWN_PLANS}", DRAWN),)
    )


def _world(row: pd.Series) -> tuple[str, ...]:
    return (*(f"{row[name]:g}" for name in WORLD), f"{row['rho']:.2f}")


def seeds(rows: pd.DataFrame) -> str:
    """Say how many seeds there are, where there are several."""
    count = rows["seed"].nunique()
    return f", mean and range of {count} seeds" if count > 1 else ""


def _caution(row: pd.Series) -> str:
    """Write lambda; absent where whole plans are waited for."""
    import pandas as pd

    return ABSENT if pd.isna(row["caution"]) else f"{row['caution']:g}"
