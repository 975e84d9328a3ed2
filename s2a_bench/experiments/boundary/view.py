"""The tables and JSON of a boundary run, and its figure: where naive is stall-free (the paper's figure 2)."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.boundary.rows import BOUNDARY, BoundaryRow
from s2a_bench.experiments.cells import Cells, json_of
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.figures import new_figure, shade_plane, write_beside
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ABSENT, EMULATED, PAPERS, Note, TextTable, number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_CSV = ("duration", "duration_s", "tokens_per_skill", "tokens_per_s", "board", "stall_free", "plans", "p_stall")
DURATIONS = ("t_nom", "t_min")
_FREE, _BETWEEN, _STALLS = "#009E73", "#F0E442", "#D55E00"
_SHADE: Final = 0.3
_INK: Final = "#222222"
_TRIALS: Final[dict[str, dict[str, Any]]] = {
    "trial: no stall": {"marker": "o", "facecolors": "none", "edgecolors": _INK},
    "trial: stalls": {"marker": "x", "color": _INK},
}


def show(run: StoredRun, **_: Any) -> Shown:
    return Shown.build(
        sentences=partial(_boundary_sentences, run),
        tables={"boundary": partial(line_table, run), "boards": partial(board_table, run)},
        main=["boards"],
        csvs=lambda: {"boundary.csv": CsvTable.of_frame(run.table(BOUNDARY)[[*_CSV, PROVENANCE]])},
        figures=lambda: {"boundary": partial(build_boundary, run)},
        json=lambda: frame(run, [_json(row) for row in Cells.of(run, BOUNDARY).rows], []),
    )


def grid_of(run: StoredRun, duration: str) -> pd.DataFrame:
    rows = run.table(BOUNDARY)
    return rows[(rows["duration"] == duration) & (rows["board"] == "")]


def marks_of(run: StoredRun) -> list[tuple[str, float, pd.DataFrame]]:
    """Return title and rate of each board with its points, in the order of the options."""
    rows = run.table(BOUNDARY)
    boards = run.manifest["boards"]
    return [(board["title"], board["tokens_per_s"], rows[rows["board"] == board["name"]]) for board in boards]


def is_random(run: StoredRun) -> bool:
    """Return whether the plans of a point differ."""
    return bool((run.table(BOUNDARY)["plans"] > 1).any())


def board_table(run: StoredRun) -> TextTable:
    """Return the table of the boards: gap between skills, and whether naive is stall-free."""
    groups = []
    for title, rate, points in marks_of(run):
        nominal, least = (points[points["duration"] == name].to_dict("records") for name in DURATIONS)
        rows: list[tuple[str, ...]] = []
        for one, other in zip(nominal, least, strict=True):
            gap_s = one["tokens_per_skill"] / rate
            verdicts = (_verdict(point, random=is_random(run)) for point in (one, other))
            numbers = (str(one["tokens_per_skill"]), number(gap_s), number(gap_s / one["duration_s"]))
            rows.append((title, *numbers, *verdicts))
        groups.append(rows)
    names = [board["name"] for board, group in zip(run.manifest["boards"], groups, strict=True) for _ in group]
    header = ("board", "L", "L/R (s)", "rho", "at T_nom", "at T_min")
    return TextTable.grouped("Boards: is naive stall-free?", header, groups, 1, _notes(run), once=1, cells=names)


def line_table(run: StoredRun) -> TextTable:
    """Return the table of the slowest stall-free rates: L / T, and the slowest rate that passed the trial."""
    rows = []
    for tokens in sorted(grid_of(run, "t_nom")["tokens_per_skill"].unique()):
        row = [str(tokens)]
        for name in DURATIONS:
            points = grid_of(run, name)
            mine = points[points["tokens_per_skill"] == tokens].sort_values("tokens_per_s")
            passed = mine[mine["p_stall"] == 0]["tokens_per_s"]
            row += [number(tokens / float(mine["duration_s"].iloc[0])), number(passed.min()) if len(passed) else ABSENT]
        rows.append(tuple(row))
    header = ("L", "T_nom: formula", "trial", "T_min: formula", "trial")
    return TextTable("Slowest rate without stalls under naive, in tokens/s", header, rows, 1)


def _boundary_sentences(run: StoredRun) -> list[str]:
    points = len(run.table(BOUNDARY))
    sentences = [f"Naive execution was tried at {points} points of rate and tokens per skill."]
    if is_random(run):
        shares = grid_of(run, DURATIONS[0])["p_stall"]
        sentences.append(
            f"A plan stalls at {int((shares > 0).sum())} of {len(shares)} points of the grid, run for T_nom."
        )
    else:
        agree = points - disagreements(run)
        sentences.append(f"The formula R >= L/T says whether it stalls, and is right at {agree} of {points} points.")
    return sentences


def disagreements(run: StoredRun) -> int:
    """Count the points where formula and trial differ; meaningful for even tokens only."""
    rows = run.table(BOUNDARY)
    return int(((rows["p_stall"] == 0) != rows["stall_free"]).sum())


def _json(row: BoundaryRow) -> dict[str, Any]:
    rho = row.tokens_per_skill / row.tokens_per_s / row.duration_s
    return {**json_of(row), "rho": rho, "emulated": True}


def _verdict(point: dict[Any, Any], *, random: bool) -> str:
    verdict = "stall-free" if point["stall_free"] else "stalls"
    return f"{verdict}, P = {point['p_stall']:.1%}" if random else verdict


def _notes(run: StoredRun) -> tuple[str, ...]:
    points = len(run.table(BOUNDARY))
    notes = [
        "Naive runs every skill for T_nom. The paper draws the line for T_min, which holds if skills may end early."
    ]
    if is_random(run):
        plans = int(run.table(BOUNDARY)["plans"].max())
        jitter = run.manifest["configuration"]["jitter"]
        notes.append(f"P: share of {plans} drawn plans with a stall, jitter {jitter}; the formula is for even tokens.")
    else:
        notes.append(f"Formula and trial agree at {points - disagreements(run)} of {points} points.")
    if any(board["origin"] == "paper" for board in run.manifest["boards"]):
        rates = "EMULATED: the boards' rates are the paper's (table II); nothing was measured."
        notes.append(Note(rates, EMULATED, PAPERS))
    return tuple(notes)


def build_boundary(run: StoredRun) -> Figure:
    """Draw the lines R = L / T_nom and R = L / T_min, the trials, and the boards.

    Without jitter the formula's regions are shaded and every trial is a mark; with jitter P(a plan stalls) is shaded.
    """
    figure = new_figure(3.4, _caption(run))
    axes = figure.subplots()
    nominal = grid_of(run, "t_nom")
    low, high = float(nominal["tokens_per_s"].min()), float(nominal["tokens_per_s"].max())
    most = int(nominal["tokens_per_skill"].max())
    axes.set_yscale("log")
    axes.set_xlim(0.5, most + 0.5)
    axes.set_ylim(low, high)
    lines = {name: float(grid_of(run, name)["duration_s"].iloc[0]) for name in ("t_nom", "t_min")}
    tokens = np.linspace(0.5, most + 0.5, 200)
    if is_random(run):
        mesh = shade_plane(axes, nominal, "tokens_per_skill", "tokens_per_s", "p_stall", cmap="Oranges", vmin=0, vmax=1)
        figure.colorbar(mesh, ax=axes, location="top", label="P(a plan stalls), naive at $T_\\mathrm{nom}$", pad=0.02)
    else:
        _shade_regions(axes, tokens, lines, low, high)
        _mark_trials(axes, run)
    styles = {
        "t_nom": ("-", r"$R = L\,/\,T_\mathrm{nom}$ (naive as it runs)"),
        "t_min": ("--", r"$R = L\,/\,T_\mathrm{min}$ (the paper's line)"),
    }
    for name, duration_s in lines.items():
        style, label = styles[name]
        axes.plot(tokens, tokens / duration_s, style, color="black", label=label)
    _mark_boards(axes, run)
    axes.set_xticks(range(1, most + 1))
    axes.yaxis.set_major_formatter(lambda value, _place: f"{value:g}")
    axes.set_xlabel("tokens per skill, L")
    axes.set_ylabel("rate, R (tokens/s)")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.0)
    return figure


def _shade_regions(axes: Axes, tokens: np.ndarray, lines: dict[str, float], low: float, high: float) -> None:
    nominal, least = tokens / lines["t_nom"], tokens / lines["t_min"]
    for below, above, colour, label in (
        (least, high, _FREE, "stall-free"),
        (nominal, least, _BETWEEN, r"stall-free only at $T_\mathrm{nom}$"),
        (low, nominal, _STALLS, "naive stalls"),
    ):
        axes.fill_between(tokens, below, above, color=colour, alpha=_SHADE, linewidth=0, label=label)


def _mark_trials(axes: Axes, run: StoredRun) -> None:
    points = grid_of(run, "t_nom")
    free = points["p_stall"] == 0
    for chosen, (label, style) in zip((points[free], points[~free]), _TRIALS.items(), strict=True):
        axes.scatter(chosen["tokens_per_skill"], chosen["tokens_per_s"], 7, linewidths=0.5, label=label, **style)


def _mark_boards(axes: Axes, run: StoredRun) -> None:
    for title, rate, points in marks_of(run):
        nominal = points[points["duration"] == "t_nom"]
        axes.axhline(rate, color=_INK, linewidth=0.5, linestyle=":")
        write_beside(axes, rate, f"{title}\n{rate:g} tokens/s")
        for free, face in ((True, _INK), (False, "white")):
            chosen = nominal[nominal["stall_free"] == free]
            axes.plot(
                chosen["tokens_per_skill"],
                chosen["tokens_per_s"],
                "s",
                markersize=4.5,
                color=_INK,
                markerfacecolor=face,
                markeredgewidth=0.9,
            )


def _caption(run: StoredRun) -> tuple[str, ...]:
    settings = run.manifest["configuration"]
    t_nom_s = settings["t_nom_s"]
    facts = [f"N = {settings['n_skills']}", f"T_nom = {t_nom_s:g} s", f"T_min = {settings['t_min'] * t_nom_s:g} s"]
    jitter = f"{settings['plans']} plans a point, jitter {settings['jitter']}"
    facts.append(jitter if is_random(run) else "tokens come evenly")
    paper = any(board["origin"] == "paper" for board in run.manifest["boards"])
    rates = " at the paper's rates (not measured)" if paper else ""
    squares = f"Squares: boards{rates}, filled where the formula says stall-free."
    return ("Stall-free region of naive execution", f"{', '.join(facts)}.", *([squares] if marks_of(run) else []))
