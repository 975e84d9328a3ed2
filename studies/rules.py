"""How the studies of rules are shown: what helps against a shift, and what each split of the stretch costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.style import WIDE_IN
from s2a_bench.writers.tables import DRAWN, Note, TextTable
from studies.tables import DRAWN_PLANS, mean_of, over_seeds, rows_of, seeds

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_STYLES: Final = {
    "fixed": ("#D55E00", "s"),
    "tracked": ("#0072B2", "o"),
    "detected": ("#009E73", "^"),
    "both": ("k", "D"),
}
_COLOURS: Final = {"high-confidence": "#0072B2", "expected": "#D55E00"}
_SETTING: Final = ["tokens_per_s", "tokens_per_skill", "n_skills", "t_nom_s"]


def shift_tables(rows: pd.DataFrame) -> Iterator[TextTable]:
    """Show, for every shift, what each way to go on comes to: means over the settings."""
    rows = _arms(rows)
    settings = len(rows.groupby(_SETTING))
    note = Note(f"{settings} settings, {int(rows['plans'].max())} plans each{seeds(rows)}. {DRAWN_PLANS}", DRAWN)
    about = (
        "fixed: lambda and prior of the calibration. tracked: lambda follows the plans. detected: changes of the rate "
        "within a plan are looked for."
    )
    for title, column, form, worst in (
        ("Shift: P(any stall)", "p_any_stall", "{:.1%}", False),
        ("Shift: P(any stall), worst setting", "p_any_stall", "{:.0%}", True),
        ("Shift: stalls a plan", "stalls", "{:.2f}", False),
        ("Shift: started before S_lo", "p_too_early", "{:.1%}", False),
        ("Shift: start regret over S0", "start_regret", "{:.0%}", False),
    ):
        arms = list(dict.fromkeys(rows["arm"]))
        lines = []
        for shift, part in rows.groupby("shift", sort=False):
            each = [part[part["arm"] == arm] for arm in arms]
            statistic = _worst(column) if worst else mean_of(column)
            lines.append((str(shift), *(over_seeds(mine, statistic, form) for mine in each)))
        yield TextTable(title, ("shift", *arms), lines, 1, notes=(note, about))


def split_tables(rows: pd.DataFrame) -> Iterator[TextTable]:
    """Show what each rule comes to under each guarantee: means over the settings."""
    columns = {
        "P(stall)": ("p_any_stall", "{:.2%}"),
        "over S_lo": ("start_regret_elastic", "{:.1%}"),
        "over S0": ("start_regret", "{:.1%}"),
        "end over E_lo": ("end_regret_elastic", "{:.1%}"),
        "distortion": ("speed_distortion", "{:.3f}"),
    }
    lines = [
        (
            str(guarantee),
            str(policy),
            *(over_seeds(part, mean_of(column), form) for column, form in columns.values()),
            over_seeds(part, _worst("p_any_stall"), "{:.1%}"),
        )
        for (guarantee, policy), part in rows.groupby(["condition", "policy"], sort=False)
    ]
    lines.sort(key=lambda line: line[0], reverse=True)
    settings = len(rows.groupby(_SETTING))
    notes = (
        Note(f"{settings} settings with rho > .8, each rule calibrated there{seeds(rows)}. {DRAWN_PLANS}", DRAWN),
        "over S_lo, S0: start regret. distortion: durations over nominal ones. worst: P(stall) of the worst setting.",
    )
    yield TextTable("Split", ("guarantee", "rule", *columns, "worst"), lines, 2, notes=notes)


def build_shift(run: StoredRun) -> Figure:
    """Draw P(any stall) under every shift, a mark a way to go on, a line over the range of the seeds."""
    rows = _arms(rows_of(run))
    shifts = list(dict.fromkeys(rows["shift"]))
    figure = new_figure(0.8 + 0.32 * len(shifts), f"Calibrated without shift{seeds(rows)}\n{DRAWN_PLANS}", WIDE_IN)
    axes = figure.subplots()
    for step, (arm, (colour, marker)) in enumerate(_STYLES.items()):
        for place, shift in enumerate(shifts):
            mine = rows[(rows["arm"] == arm) & (rows["shift"] == shift)]
            shares = 100 * mine.groupby("seed")["p_any_stall"].mean()
            height = place + 0.16 * (step - 1.5)
            axes.hlines(height, shares.min(), shares.max(), color=colour, linewidth=1)
            label = arm if not place else None
            axes.plot(shares.mean(), height, marker, color=colour, markersize=4, label=label)
    axes.axvline(100 * float(run.manifest["configuration"]["epsilon"]), color="#999999", linewidth=0.6, linestyle=":")
    axes.set_yticks(range(len(shifts)), shifts)
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=0.5, linscale=0.5)
    axes.set_xlim(0, 100)
    axes.set_xticks([0, 1, 10, 100], ["0", "1", "10", "100"])
    axes.set_xlabel("P(any stall) (%), mean over the settings")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=len(_STYLES))
    return figure


def build_split(run: StoredRun) -> Figure:
    """Draw start regret over S_lo against distortion, a mark a rule, a colour a guarantee."""
    rows = rows_of(run)
    figure = new_figure(3.6, f"What an early start costs{seeds(rows)}\n{DRAWN_PLANS}", WIDE_IN)
    axes = figure.subplots()
    for guarantee, colour in _COLOURS.items():
        mine = rows[rows["condition"] == guarantee]
        means = mine.groupby("policy", sort=False)[["speed_distortion", "start_regret_elastic", "p_any_stall"]].mean()
        label = f"{guarantee}: P(stall) {means['p_any_stall'].mean():.1%}"
        axes.plot(means["speed_distortion"], 100 * means["start_regret_elastic"], "o", color=colour, label=label)
        for name, point in means.iterrows():
            text = str(name).partition("?")[2] or str(name)
            at = (point["speed_distortion"], 100 * point["start_regret_elastic"])
            axes.annotate(text, at, (3, 3), textcoords="offset points", fontsize=6)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("durations over nominal ones")
    axes.set_ylabel(r"start regret over $S_\mathrm{lo}$ (%)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center")
    return figure


def _arms(rows: pd.DataFrame) -> pd.DataFrame:
    """Split the condition into shift and arm."""
    parts = [text.rpartition(", ") for text in rows["condition"]]
    return rows.assign(shift=[part[0] for part in parts], arm=[part[2] for part in parts])


def _worst(column: str) -> Callable[[pd.DataFrame], float]:
    """Return what takes the largest of a column."""
    return lambda rows: float(rows[column].astype("float64").max())
