"""What each control tick did, a lane a mode: which chunk its action was from, stalls, waits, and how old it was."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.chunks.rows import REQUESTS, TICKS
from s2a_bench.experiments.chunks.view.tables import rows_of
from s2a_bench.writers.figures import LINE_CHARS, new_figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run

MOST_LANES: Final = 12
"""More would not be legible; chunk_ticks.csv has all."""
WIDE_IN: Final = 7.16
COLOURS: Final = ("#0072B2", "#56B4E9", "#009E73")
"""Of chunks that follow one another."""
_STALL: Final[dict[str, Any]] = {"facecolor": "white", "edgecolor": "#444444", "hatch": "//////", "linewidth": 0.4}
_BAR: Final = 0.34
_AGE: Final = 0.42
"""Height of the greatest age."""


@dataclass(frozen=True, slots=True)
class Lane:
    """The first ticks of one cell, and the requests that left in them."""

    name: str
    rule: str
    source: str
    ticks: pd.DataFrame
    requests: pd.DataFrame
    period_s: float

    @property
    def title(self) -> str:
        """Return the mode, and the rule that chose its trigger if one did."""
        return self.name if self.rule == "given" else f"{self.name}, {self.rule}"


def lanes_of(run: Run) -> list[Lane]:
    """Return the lanes of a run: the modes as given, and the calibrated trigger."""
    ticks, requests = run.table(TICKS), run.table(REQUESTS)
    shown = int(run.manifest["configuration"]["shown_ticks"])
    ticks, requests = ticks[ticks["tick"] < shown], requests[requests["request_tick"] < shown]
    found = []
    for row in rows_of(run):
        mine = ticks[ticks["cell"] == row["cell"]]
        if len(mine) and row["rule"] in {"given", "calibrated"}:
            asked = requests[requests["cell"] == row["cell"]]
            found.append(Lane(row["mode"], row["rule"], row["latency"], mine, asked, row["delta_t_s"]))
    return found[:MOST_LANES]


def build_lanes(run: Run) -> Figure:
    """Draw the lanes below one another: actions coloured by chunk, stalls hatched, requests above, ages below."""
    lanes = lanes_of(run)
    asked = run.manifest["configuration"]
    several = len({lane.source for lane in lanes}) > 1
    setting = f"H = {asked['horizon']}, {asked['control_hz']:g} Hz, d by {asked['rounding']}"
    source = "" if several else f" @ {lanes[0].source}"
    title = f"What each control tick executes{source}, {setting}"
    figure = new_figure(0.75 + 0.55 * len(lanes), textwrap.fill(title, 2 * LINE_CHARS), WIDE_IN)
    axes = figure.subplots()
    oldest = max(int(lane.ticks["age_ticks"].fillna(0).max()) for lane in lanes) or 1
    for place, lane in enumerate(lanes):
        draw_lane(axes, lane, place, oldest)
    axes.set_yticks(range(len(lanes)), [_label(lane, several=several) for lane in lanes])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(lanes) - 0.33, -0.6)
    axes.set_xlim(0, max(len(lane.ticks) for lane in lanes))
    axes.set_xlabel("control tick")
    figure.legend(handles=_legend(oldest), loc="outside lower center", ncols=5, columnspacing=1.0)
    return figure


def draw_lane(axes: Axes, lane: Lane, place: int, oldest: int) -> None:
    """Draw one lane around y = ``place``; ``oldest`` is the age that the curve below reaches the next lane with."""
    top = place - _BAR / 2
    chunk = lane.ticks["chunk"].fillna(-1).to_numpy(dtype="int64")
    stalled = lane.ticks["stalled"].to_numpy(dtype="bool")
    for first, last in runs_of(np.where(stalled, -2, chunk)):
        width = last - first
        if stalled[first]:
            axes.broken_barh([(first, width)], (top, _BAR), **_STALL)
        elif chunk[first] >= 0:
            axes.broken_barh([(first, width)], (top, _BAR), color=COLOURS[chunk[first] % len(COLOURS)], linewidth=0)
    for row in lane.requests.to_dict("records"):
        leaves, usable = row["request_tick"], row["request_tick"] + row["delay_ticks"]
        axes.hlines(top - 0.07, leaves, usable, "#666666", linewidth=0.7)
        axes.plot([leaves], [top - 0.07], "|", color="#666666", markersize=3, markeredgewidth=0.7)
        if row["thrown_away"] and row["executed"] and row["start_tick"] + row["executed"] < len(chunk):
            end = row["start_tick"] + row["executed"]
            axes.annotate(
                f"\N{MINUS SIGN}{row['thrown_away']}", (end, place), ha="right", va="center", fontsize=4, color="white"
            )
    age = lane.ticks["age_ticks"].to_numpy(dtype="float64", na_value=np.nan)
    axes.step(
        np.arange(age.size + 1),
        place + _BAR / 2 + 0.03 + _AGE * np.append(age, age[-1]) / oldest,
        where="post",
        color="#D55E00",
        linewidth=0.7,
    )


def runs_of(values: np.ndarray) -> list[tuple[int, int]]:
    """Return from where to before where values are the same."""
    edges = np.flatnonzero(np.diff(values)) + 1
    bounds = [0, *edges.tolist(), values.size]
    return list(pairwise(bounds))


def _label(lane: Lane, *, several: bool) -> str:
    parts = [lane.title, lane.source] if several else [lane.title]
    return "\n".join(short(part, 30) for part in parts)


def short(text: str, most: int) -> str:
    """Return a text of ``most`` letters at most, cut off: `textwrap.shorten` leaves nothing of one long word."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _legend(oldest: int) -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(color=COLOURS[0], label="actions of one chunk (\N{MINUS SIGN}k: thrown away)"),
        Patch(**_STALL, label="stall"),
        Line2D([], [], color="#666666", linewidth=0.7, marker="|", markersize=3, label="request to usable chunk"),
        Line2D([], [], color="#D55E00", linewidth=0.7, label=f"age of the observation, down to {oldest} ticks"),
    ]
