"""How far the paper's ordering carries: the tables of followers, and the figure of numbers varied one at a time."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.ccrb.rows import FOLLOWER_STUDY, SENSITIVITY
from s2a_bench.experiments.ccrb.view.outcomes import configuration
from s2a_bench.scenario.ccrb.cars import OUTCOMES, Cars
from s2a_bench.scenario.ccrb.words import MARK, NO_SCORE, ORDERING, PAPER, ahead, law, marked
from s2a_bench.writers.figures import LINE_CHARS, new_figure
from s2a_bench.writers.style import WIDTH_IN
from s2a_bench.writers.tables import ABSENT, PAPERS, Note, TextTable

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run

WIDE_IN: Final = 7.16
SETTING: Final = ["follower", "front_gap_m", "lead_decel_mps2"]
TITLES: Final = {
    "gap_decel_mps2": "braking in gaps (m/s\N{SUPERSCRIPT TWO})",
    "build_s": "follower's brake builds up in (s)",
    "reaction_s": "follower's reaction (s)",
    "ego_jerk_mps3": "ego's jerk (m/s\N{SUPERSCRIPT THREE})",
    "rear_gap_m": "rear gap (m); over rates only",
    "onset_s": "lead's onset after the request (s)",
}


def follower_tables(run: Run) -> dict[str, TextTable]:
    """Lay out each follower at Euro NCAP's combinations: what came of the operating point, and shares of the plane."""
    found, asked = run.table(FOLLOWER_STUDY), configuration(run)
    rate = run.manifest["boards"][0]["tokens_per_s"]
    where = f"R = {rate:g} tokens/s, rear gap {asked['rear_gap_m']:g} m, gap behaviour {asked['gap']}"
    drawn = found[found["seed"].notna()]
    seeds, points = drawn["seed"].nunique(), int(drawn["points"].iloc[0])
    notes = (
        "Survives: the follower stops behind an ego whose tokens come at once, at the same gap.",
        f"{MARK} It does not: a rear outcome says nothing of the policy.",
        *(f"{law({**asked, 'follower': follower})}." for follower in dict.fromkeys(found["follower"])),
        NO_SCORE,
    )
    shares = (
        Note(ORDERING, PAPERS),
        f"Mean [least, most] of {seeds} seeds that draw {points} points of {plane_words(asked)} each.",
        "naive*: of the points where the follower survives; nobody without stalls is hit there, as it brakes alike.",
        "A front impact ends a roll-out.",
        *notes,
    )
    header = ("follower", "lead", "ordering", "survives", "rear: naive", "wait", "stream", "naive*")
    title = "Every follower at Euro NCAP's four CCRb combinations"
    return {
        "follower-shares": TextTable(f"{title}: % of the plane", header, _share_rows(drawn), 2, notes=shares),
        "followers": TextTable(
            f"{title}: {where}",
            ("follower", "lead", "survives", *PAPER),
            _point_rows(found[found["seed"].isna()]),
            2,
            notes=notes,
        ),
    }


def build_sensitivity(run: Run) -> Figure:
    """Draw the ordering's share of the plane over each varied number, the range over the seeds as a band."""
    found, asked = run.table(SENSITIVITY), configuration(run)
    shares = found.assign(share=100 * found["paper"] / found["points"])
    seeds, points = found["seed"].nunique(), int(found["points"].iloc[0])
    held = f"The paper's ordering as a share of {plane_words(asked)}: {ahead(asked)}, gap behaviour {asked['gap']}."
    lines = [
        f"{held} Mean, least and most of {seeds} seeds of {points} points; dotted: the default.",
        f"Rear: {law(asked)}. EMULATED: tokens come evenly. {NO_SCORE}",
    ]
    chars = round(LINE_CHARS * WIDE_IN / WIDTH_IN)
    figure = new_figure(3.4, "\n".join(textwrap.fill(line, chars) for line in lines), WIDE_IN)
    grid = figure.subplots(2, 3, sharey=True)
    for axes, varied in zip(grid.flat, TITLES, strict=True):
        _draw(axes, shares[shares["varied"] == varied], float(asked.get(varied, getattr(Cars(), varied))))
        axes.set_xlabel(TITLES[varied])
    for axes in grid[:, 0]:
        axes.set_ylabel("paper's ordering (%)")
        axes.set_ylim(bottom=0)
    return figure


def sensitivity_note(run: Run) -> str:
    """Return between which shares the ordering moves, number by number."""
    found = run.table(SENSITIVITY)
    summed = found.groupby(["varied", "value"], sort=False)[["paper", "points"]].sum()
    share = 100 * summed["paper"] / summed["points"]
    spans = share.groupby("varied", sort=False).agg(["min", "max"])
    names = {varied: title.split(" (")[0] for varied, title in TITLES.items()}
    said = ", ".join(f"{names[varied]} {least:.0f} to {most:.0f} %" for varied, least, most in spans.itertuples())
    return f"Sensitivity, the paper's ordering in the plane: {said}."


def plane_words(asked: dict[str, Any]) -> str:
    """Return the plane's sides in words."""
    (slow, fast), (near, far) = asked["phase_rates"], asked["phase_gaps_m"]
    return f"the plane of R {slow:g} to {fast:g} tokens/s, rear gap {near:g} to {far:g} m"


def _draw(axes: Axes, group: pd.DataFrame, default: float) -> None:
    """Draw one number's line and band."""
    share = group.groupby("value")["share"].agg(["mean", "min", "max"]).astype("float64")
    axes.fill_between(share.index, share["min"], share["max"], color="#0072B2", alpha=0.25, linewidth=0)
    axes.plot(share.index, share["mean"], "o-", color="#0072B2", linewidth=1.2, markersize=3)
    axes.axvline(default, color="#555555", linestyle=":", linewidth=1)


def _point_rows(point: pd.DataFrame) -> list[tuple[str, ...]]:
    """Return a row a setting with each policy's outcome."""
    rows = []
    for key, group in point.groupby(SETTING, sort=False):
        here = {row["policy"]: row for row in group.to_dict("records")}
        survives = "yes" if here["naive"]["survived"] else "no"
        rows.append((*_names(key), survives, *(_outcome(here[policy]) for policy in PAPER)))
    return rows


def _share_rows(drawn: pd.DataFrame) -> list[tuple[str, ...]]:
    """Return a row a setting with shares of the drawn points."""
    rows = []
    for key, group in drawn.groupby(SETTING, sort=False):
        policies = {str(policy): mine for policy, mine in group.groupby("policy", sort=False)}
        naive = policies["naive"]
        of_all = (_range(naive[name], naive["points"]) for name in ("paper", "survived"))
        rear = (_range(policies[policy]["rear"], policies[policy]["points"]) for policy in PAPER)
        rows.append((*_names(key), *of_all, *rear, _range(naive["rear_survived"], naive["survived"])))
    return rows


def _names(setting: Any) -> tuple[str, str]:
    follower, front_m, decel = setting
    return str(follower), f"{front_m:g} m, -{decel:g}"


def _outcome(row: dict[Any, Any]) -> str:
    """Return an outcome of the operating point as its code, marked where it says nothing."""
    outcome = OUTCOMES[int(row["front"]) + 2 * int(row["rear"])]
    return outcome + marked(outcome, bool(row["survived"]))


def _range(count: pd.Series[Any], of: pd.Series[Any]) -> str:
    """Return shares of the seeds in percent: the mean, the least and the most."""
    share = (100 * count[of > 0] / of[of > 0]).astype("float64")
    if share.empty:
        return ABSENT
    if share.max() == share.min():
        return f"{share.max():.0f}"
    return f"{share.mean():.0f} [{share.min():.0f}, {share.max():.0f}]"
