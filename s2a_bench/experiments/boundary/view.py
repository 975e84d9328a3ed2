"""The tables and JSON of a boundary run, and its figure: where naive is stall-free (the paper's figure 2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments import Shown
from s2a_bench.experiments.boundary.rows import BOUNDARY, BoundaryRow
from s2a_bench.experiments.cells import Cells, json_of
from s2a_bench.writers.figures import new_figure, on_page, shade_plane, write_beside
from s2a_bench.writers.json import frame
from s2a_bench.writers.tables import ABSENT, EMULATED, PAPERS, Note, TextTable, number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_CSV = ("duration", "duration_s", "tokens_per_skill", "tokens_per_s", "board", "stall_free", "plans", "p_stall")
DURATIONS = ("t_nom", "t_min")
_LINES: Final = {
    "t_nom": ("-", r"$R = L\,/\,T_\mathrm{nom}$ (naive as it runs)"),
    "t_min": ("--", r"$R = L\,/\,T_\mathrm{min}$ (the paper's line)"),
}
_FREE, _BETWEEN, _STALLS = "#009E73", "#F0E442", "#D55E00"
_SHADE: Final = 0.3
_INK: Final = "#222222"
_TRIALS: Final[dict[str, dict[str, Any]]] = {
    "trial: no stall": {"marker": "o", "facecolors": "none", "edgecolors": _INK},
    "trial: stalls": {"marker": "x", "color": _INK},
}


@dataclass(frozen=True, slots=True)
class BoardPoints:
    """A board that is marked, and its points; ``origin`` says where its rate is from."""

    name: str
    title: str
    origin: str
    tokens_per_s: float
    points: Sequence[BoundaryRow]

    def at(self, duration: str) -> list[BoundaryRow]:
        return [point for point in self.points if point.duration == duration]


def show(run: StoredRun, **_: Any) -> Shown:
    cells, settings = Cells.of(run, BOUNDARY), run.manifest["configuration"]
    random = is_random(cells)
    grid: dict[str, pd.DataFrame] = {duration: grid_of(cells, duration) for duration in DURATIONS}
    boards = [BoardPoints(**board, points=cells.where(board=board["name"]).rows) for board in run.manifest["boards"]]
    caption = _caption(settings, boards, random=random)
    return Shown.build(
        sentences=lambda: [*_sentences(cells, grid["t_nom"], boards)],
        tables={
            "boundary": lambda: line_table(grid),
            "boards": lambda: board_table(boards, _notes(cells, boards, settings["jitter"]), random=random),
        },
        main=["boards"],
        csvs=lambda: {"boundary.csv": cells.csv(_CSV)},
        figures=lambda: {"boundary": lambda: build_boundary(caption, grid, boards, random=random)},
        json=lambda: frame(run, [_json(row) for row in cells.rows], []),
    )


def grid_of(cells: Cells[BoundaryRow], duration: str) -> pd.DataFrame:
    """Return the points of the grid, without those of boards."""
    return cells.where(duration=duration, board="").frame


def is_random(cells: Cells[BoundaryRow]) -> bool:
    """Return whether the plans of a point differ."""
    return bool((cells.frame["plans"] > 1).any())


def board_table(boards: Sequence[BoardPoints], notes: Sequence[str], *, random: bool) -> TextTable:
    """Return the table of the boards: gap between skills, and whether naive is stall-free."""
    groups: list[list[tuple[str, ...]]] = []
    for board in boards:
        rows: list[tuple[str, ...]] = []
        for nominal, least in zip(*map(board.at, DURATIONS), strict=True):
            gap_s = nominal.tokens_per_skill / board.tokens_per_s
            numbers = (str(nominal.tokens_per_skill), number(gap_s), number(gap_s / nominal.duration_s))
            verdicts = (_verdict(point, random=random) for point in (nominal, least))
            rows.append((board.title, *numbers, *verdicts))
        groups.append(rows)
    names = [board.name for board, rows in zip(boards, groups, strict=True) for _ in rows]
    header = ("board", "L", "L/R (s)", "rho", "at T_nom", "at T_min")
    return TextTable.grouped("Boards: is naive stall-free?", header, groups, 1, notes, once=1, cells=names)


def line_table(grid: Mapping[str, pd.DataFrame]) -> TextTable:
    """Return the table of the slowest stall-free rates: L / T, and the slowest rate that passed the trial."""
    rows = []
    for tokens in sorted(grid["t_nom"]["tokens_per_skill"].unique()):
        row = [str(tokens)]
        for points in grid.values():
            mine = points[points["tokens_per_skill"] == tokens]
            passed = mine[mine["p_stall"] == 0]["tokens_per_s"]
            row += [number(tokens / float(mine["duration_s"].iloc[0])), number(passed.min()) if len(passed) else ABSENT]
        rows.append(tuple(row))
    header = ("L", "T_nom: formula", "trial", "T_min: formula", "trial")
    return TextTable("Slowest rate without stalls under naive, in tokens/s", header, rows, 1)


def _sentences(cells: Cells[BoundaryRow], nominal: pd.DataFrame, boards: Sequence[BoardPoints]) -> Iterator[str]:
    for board in boards:
        stalls = ", ".join(str(point.tokens_per_skill) for point in board.at("t_nom") if point.p_stall > 0)
        yield f"{board.title}: naive {f'stalls at L = {stalls}' if stalls else 'never stalls'}."
    if is_random(cells):
        stalling = int((nominal["p_stall"] > 0).sum())
        yield f"A plan stalls at {stalling} of {len(nominal)} points of rate and tokens per skill, run for T_nom."
    else:
        agree = int(((cells.frame["p_stall"] == 0) == cells.frame["stall_free"]).sum())
        yield f"The formula R >= L/T says whether naive stalls: it is right at {agree} of {len(cells)} points tried."


def _json(row: BoundaryRow) -> dict[str, Any]:
    rho = row.tokens_per_skill / row.tokens_per_s / row.duration_s
    return {**json_of(row), "rho": rho, "emulated": True}


def _verdict(point: BoundaryRow, *, random: bool) -> str:
    verdict = "stall-free" if point.stall_free else "stalls"
    return f"{verdict}, P = {point.p_stall:.1%}" if random else verdict


def _notes(cells: Cells[BoundaryRow], boards: Sequence[BoardPoints], jitter: str) -> list[str]:
    notes = [
        "Naive runs every skill for T_nom. The paper draws the line for T_min, which holds if skills may end early."
    ]
    if is_random(cells):
        plans = int(cells.frame["plans"].max())
        notes.append(f"P: share of {plans} drawn plans with a stall, jitter {jitter}; the formula is for even tokens.")
    if any(board.origin == "paper" for board in boards):
        rates = "EMULATED: the boards' rates are the paper's (table II); nothing was measured."
        notes.append(Note(rates, EMULATED, PAPERS))
    return notes


def build_boundary(
    caption: Sequence[str], grid: Mapping[str, pd.DataFrame], boards: Sequence[BoardPoints], *, random: bool
) -> Figure:
    """Draw the lines R = L / T_nom and R = L / T_min, the trials, and the boards.

    Without jitter the formula's regions are shaded and every trial is a mark; with jitter P(a plan stalls) is shaded.
    """
    figure = new_figure(3.4, caption)
    axes = figure.subplots()
    nominal = grid["t_nom"]
    low, high = float(nominal["tokens_per_s"].min()), float(nominal["tokens_per_s"].max())
    most = int(nominal["tokens_per_skill"].max())
    axes.set_yscale("log")
    axes.set_xlim(0.5, most + 0.5)
    axes.set_ylim(low, high)
    lines = {duration: float(points["duration_s"].iloc[0]) for duration, points in grid.items()}
    tokens = np.linspace(0.5, most + 0.5, 200)
    if random:
        mesh = shade_plane(axes, nominal, "tokens_per_skill", "tokens_per_s", "p_stall", cmap="Oranges", vmin=0, vmax=1)
        figure.colorbar(mesh, ax=axes, location="top", label="P(a plan stalls), naive at $T_\\mathrm{nom}$", pad=0.02)
    else:
        _shade_regions(axes, tokens, lines, low, high)
        _mark_trials(axes, nominal)
    for duration, (style, label) in _LINES.items():
        axes.plot(tokens, tokens / lines[duration], style, color="black", label=label)
    for board in boards:
        _mark_board(axes, board)
    axes.set_xticks(range(1, most + 1))
    axes.yaxis.set_major_formatter(lambda value, _place: f"{value:g}")
    axes.set_xlabel("tokens per skill, L")
    axes.set_ylabel("rate, R (tokens/s)")
    figure.legend(loc="outside lower center", ncols=4 if on_page() else 2, columnspacing=1.0)
    return figure


def _shade_regions(axes: Axes, tokens: np.ndarray, lines: dict[str, float], low: float, high: float) -> None:
    nominal, least = tokens / lines["t_nom"], tokens / lines["t_min"]
    for below, above, colour, label in (
        (least, high, _FREE, "stall-free"),
        (nominal, least, _BETWEEN, r"stall-free only at $T_\mathrm{nom}$"),
        (low, nominal, _STALLS, "naive stalls"),
    ):
        axes.fill_between(tokens, below, above, color=colour, alpha=_SHADE, linewidth=0, label=label)


def _mark_trials(axes: Axes, points: pd.DataFrame) -> None:
    free = points["p_stall"] == 0
    for chosen, (label, style) in zip((points[free], points[~free]), _TRIALS.items(), strict=True):
        axes.scatter(chosen["tokens_per_skill"], chosen["tokens_per_s"], 7, linewidths=0.5, label=label, **style)


def _mark_board(axes: Axes, board: BoardPoints) -> None:
    axes.axhline(board.tokens_per_s, color=_INK, linewidth=0.5, linestyle=":")
    write_beside(axes, board.tokens_per_s, f"{board.title}\n{board.tokens_per_s:g} tokens/s")
    square: dict[str, Any] = {"marker": "s", "linestyle": "", "markersize": 4.5, "color": _INK, "markeredgewidth": 0.9}
    for free, face in ((True, _INK), (False, "white")):
        tokens = [point.tokens_per_skill for point in board.at("t_nom") if point.stall_free == free]
        axes.plot(tokens, [board.tokens_per_s] * len(tokens), markerfacecolor=face, **square)


def _caption(settings: Mapping[str, Any], boards: Sequence[BoardPoints], *, random: bool) -> tuple[str, ...]:
    t_nom_s = settings["t_nom_s"]
    facts = [f"N = {settings['n_skills']}", f"T_nom = {t_nom_s:g} s", f"T_min = {settings['t_min'] * t_nom_s:g} s"]
    facts.append(f"{settings['plans']} plans a point, jitter {settings['jitter']}" if random else "tokens come evenly")
    title, notes = "Stall-free region of naive execution", [f"{', '.join(facts)}."]
    if boards:
        paper = any(board.origin == "paper" for board in boards)
        rates = " at the paper's rates (not measured)" if paper else ""
        notes.append(f"Squares: boards{rates}, filled where the formula says stall-free.")
    return (title, *notes)
