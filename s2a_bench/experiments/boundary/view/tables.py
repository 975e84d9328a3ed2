"""The tables of a boundary run, and its ``--json`` object."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from s2a_bench.experiments.boundary.rows import BOUNDARY
from s2a_bench.experiments.boundary.view.cell import BoundaryCell
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.writers.as_json import frame
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.tables import ABSENT, EMULATED, PAPERS, Note, TextTable, number

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import Run

DURATIONS = ("t_nom", "t_min")
"""As skills are executed, and as the paper draws the line."""


def grid_of(run: Run, duration: str) -> pd.DataFrame:
    """Return the points of the grid for one duration."""
    rows = run.table(BOUNDARY)
    return rows[(rows["duration"] == duration) & (rows["board"] == "")]


def marks_of(run: Run) -> list[tuple[str, float, pd.DataFrame]]:
    """Return title and rate of each board with its points, in the order asked for."""
    rows = run.table(BOUNDARY)
    boards = run.manifest["boards"]
    return [(board["title"], board["tokens_per_s"], rows[rows["board"] == board["name"]]) for board in boards]


def is_random(run: Run) -> bool:
    """Return whether plans differ at a point."""
    return bool((run.table(BOUNDARY)["plans"] > 1).any())


def board_table(run: Run) -> TextTable:
    """Lay out the boards: gap between skills, and whether naive is stall-free there."""
    rows: list[tuple[str, ...]] = []
    rules = []
    for title, rate, points in marks_of(run):
        rules.append(len(rows))
        nominal, least = (points[points["duration"] == name] for name in DURATIONS)
        for place, (one, other) in enumerate(zip(nominal.to_dict("records"), least.to_dict("records"), strict=True)):
            tokens = one["tokens_per_skill"]
            row = [
                title if not place else "",
                str(tokens),
                number(tokens / rate),
                number(tokens / rate / one["duration_s"]),
            ]
            rows.append((*row, *(_verdict(point, random=is_random(run)) for point in (one, other))))
    header = ("board", "L", "L/R (s)", "rho", "at T_nom", "at T_min")
    return TextTable("Boards: is naive stall-free?", header, rows, 1, frozenset(rules[1:]), _notes(run))


def line_table(run: Run) -> TextTable:
    """Lay out the slowest stall-free rate: L / T, and the slowest of the grid's rates that passed the trial."""
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


def boundary_tables(run: Run) -> dict[str, TextTable]:
    """Return every table of a run by its file's name."""
    return {"boundary": line_table(run), "boards": board_table(run)}


def boundary_csv(run: Run) -> dict[str, CsvTable]:
    """Return file name -> CSV table: every point of the plane and of the boards."""
    names = ("duration", "duration_s", "tokens_per_skill", "tokens_per_s", "board", "stall_free", "plans", "p_stall")
    return {"boundary.csv": CsvTable.of(names, run.table(BOUNDARY)[list(names)].itertuples(index=False, name=None))}


def boundary_json(run: Run) -> dict[str, Any]:
    """Return the object that ``--json`` prints; a cell a point."""
    return frame(run, list(_cells(run)), [])


def boundary_sentences(run: Run) -> list[str]:
    """Return whether the formula holds, and what the paper's line leaves out."""
    points = len(run.table(BOUNDARY))
    said = [f"Naive execution was tried at {points} points of rate and tokens per skill."]
    if is_random(run):
        shares = grid_of(run, DURATIONS[0])["p_stall"]
        said.append(f"A plan stalls at {int((shares > 0).sum())} of {len(shares)} points of the grid, run for T_nom.")
    else:
        agree = points - disagreements(run)
        said.append(f"The formula R >= L/T says whether it stalls, and is right at {agree} of {points} points.")
    return said


def disagreements(run: Run) -> int:
    """Count the points where formula and trial differ; with jitter they must, so that only even tokens tell."""
    rows = run.table(BOUNDARY)
    return int(((rows["p_stall"] == 0) != rows["stall_free"]).sum())


def _cells(run: Run) -> Iterator[dict[str, Any]]:
    for row in run.table(BOUNDARY).drop(columns=PROVENANCE).to_dict("records"):
        rate, board = row.pop("tokens_per_s"), row.pop("board")
        rho = row["tokens_per_skill"] / rate / row["duration_s"]
        named: dict[str, Any] = {str(name): value for name, value in row.items()}
        yield asdict(BoundaryCell(**named, rate_tokens_per_s=rate, profile=board or None, rho=rho, emulated=True))


def _verdict(point: dict[Any, Any], *, random: bool) -> str:
    """Return whether a point is stall-free; with jitter how often it is not."""
    said = "stall-free" if point["stall_free"] else "stalls"
    return f"{said}, P = {point['p_stall']:.1%}" if random else said


def _notes(run: Run) -> tuple[str, ...]:
    """Return what a reader must know besides the numbers."""
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
        rates = "EMULATED: the boards' rates are the paper's (table II); nothing was measured here."
        notes.append(Note(rates, EMULATED, PAPERS))
    return tuple(notes)
