"""Figure 3 of the paper as curves: positions, speeds and gaps under each policy, stalls and actions marked."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

from s2a_bench.experiments.ccrb.rows import SENSITIVITY, TRAJECTORIES
from s2a_bench.experiments.ccrb.view.outcomes import configuration, has, rollouts_of, survives_of, token_times_s
from s2a_bench.experiments.ccrb.view.phase_figure import build_phase
from s2a_bench.experiments.ccrb.view.sentences import origin_notes
from s2a_bench.experiments.ccrb.view.variations import build_sensitivity
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.scenario.ccrb.words import operating_point, said
from s2a_bench.writers.figures import LINE_CHARS, new_figure
from s2a_bench.writers.style import WIDTH_IN

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run

WIDE_IN: Final = 7.16
LOOKS: Final[dict[str, tuple[str, Literal["-", "--", ":"]]]] = {
    "lead": ("#0072B2", "--"),
    "ego": ("#000000", "-"),
    "rear": ("#D55E00", ":"),
}
GAPS: Final = {"front": ("#0072B2", "--"), "rear": ("#D55E00", ":")}
_PHASES: Final[dict[str, dict[str, Any]]] = {
    "waiting": {"facecolor": "#EEEEEE", "linewidth": 0},
    "acting": {"facecolor": "#BFE3D5", "edgecolor": "white", "linewidth": 0.6},
    "gap": {"facecolor": "white", "edgecolor": "#999999", "hatch": "//////", "linewidth": 0},
}
_CAPTIONS: Final = {"waiting": "no skill yet", "acting": "a skill runs", "gap": "stall: no skill is valid"}
_REST_MPS: Final = 0.1
_AFTER_S: Final = 1.0


def build_scenario(run: Run) -> Figure:
    """Draw the operating point: a column a policy; positions, speeds and gaps over time."""
    found = rollouts_of(run, "point")
    survives, rows = survives_of(found), found.to_dict("records")
    paths = {row["policy"]: _path(run, row) for row in rows}
    skills = dict(list(run.table(SKILLS).groupby("cell", sort=False)))
    chars = round(LINE_CHARS * WIDE_IN / WIDTH_IN)
    lines = [_title(run), *origin_notes(run)]
    title = "\n".join(textwrap.fill(line, chars, break_on_hyphens=False) for line in lines)
    figure = new_figure(4.6, title, WIDE_IN)
    grid = figure.subplots(3, len(rows), squeeze=False, sharex=True, sharey="row")
    token_s = token_times_s(run)
    until_s = max(float(path["time_s"].iloc[-1]) for path in paths.values())
    for column, row in enumerate(rows):
        path, cell = paths[row["policy"]], row["cell"]
        above = grid[0, column]
        above.set_title(f"{row['policy']}: {_verdict(row, survives)}", loc="left", pad=3)
        for axes in grid[:, column]:
            _shade(axes, path, skills[cell])
            axes.set_xlim(0, until_s)
        _draw_cars(above, path, "position_m")
        # Along the lower edge, whatever the positions.
        edge = above.get_xaxis_transform()
        above.plot(token_s, [0.04] * len(token_s), "|", color="#555555", markersize=5, transform=edge, clip_on=False)
        _draw_cars(grid[1, column], path, "speed_kmh")
        _draw_gaps(grid[2, column], path, row)
        grid[2, column].set_xlabel("time from the request (s)")
    for axes, label in zip(grid[:, 0], ("position (m)", "speed (km/h)", "gap (m)"), strict=True):
        axes.set_ylabel(label)
    grid[2, 0].set_ylim(bottom=0)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=4)
    return figure


def ccrb_figures(run: Run) -> dict[str, Callable[[], Figure]]:
    """Return every figure by its file's name; those of studies where the run has them."""
    builders: dict[str, Callable[[], Figure]] = {"scenario": partial(build_scenario, run)}
    if has(run, "phase"):
        builders["phase"] = partial(build_phase, run)
    if len(run.table(SENSITIVITY)):
        builders["sensitivity"] = partial(build_sensitivity, run)
    return builders


def path_of(run: Run, cell: str) -> pd.DataFrame:
    """Return the trajectory of a shown roll-out with times in s, speeds in km/h, and gaps."""
    rows = run.table(TRAJECTORIES)
    path: pd.DataFrame = rows[rows["cell"] == cell].reset_index(drop=True)
    path["time_s"] = path["at_ns"] / 1e9
    for car in LOOKS:
        path[f"{car}_speed_kmh"] = path[f"{car}_speed_mps"] * 3.6
    path["front_gap_m"] = path["lead_position_m"] - path["ego_position_m"]
    path["rear_gap_m"] = path["ego_position_m"] - path["rear_position_m"]
    return path


def _path(run: Run, row: dict[Any, Any]) -> pd.DataFrame:
    """Return a trajectory up to rest; after an impact from behind the trailing car is out."""
    path = path_of(run, row["cell"])
    moving = path[[f"{car}_speed_mps" for car in LOOKS]].max(axis=1) > _REST_MPS
    last = int(moving[moving].index[-1]) if moving.any() else 0
    shown = path["time_s"] <= float(path["time_s"].iloc[last]) + _AFTER_S
    path = path.loc[shown].copy()
    touched: Any = path.index[path["rear_gap_m"] <= 0] if row["outcome"] in {"rear", "both"} else []
    if len(touched):
        columns = [name for name in path.columns if name.startswith("rear_")]
        path.loc[touched[0] + 1 :, columns] = float("nan")
    return path


def _shade(axes: Axes, path: pd.DataFrame, skills: pd.DataFrame) -> None:
    """Shade when the ego waits, acts, and has nothing valid to do."""
    first = float(skills["start_ns"].iloc[0]) / 1e9
    axes.axvspan(0, first, zorder=0, **_PHASES["waiting"])
    last = float(path["time_s"].iloc[-1])
    for skill in skills.to_dict("records"):
        start, end, stall = (skill[f"{name}_ns"] / 1e9 for name in ("start", "end", "stall"))
        if start < last:
            axes.axvspan(start, end, zorder=0, **_PHASES["acting"])
        if stall > 0 and start - stall < last:
            axes.axvspan(start - stall, start, zorder=0, **_PHASES["gap"])


def _draw_cars(axes: Axes, path: pd.DataFrame, what: str) -> None:
    """Draw a curve a car."""
    for car, (colour, style) in LOOKS.items():
        axes.plot(path["time_s"], path[f"{car}_{what}"], style, color=colour, linewidth=1.2)


def _draw_gaps(axes: Axes, path: pd.DataFrame, row: dict[Any, Any]) -> None:
    """Draw both gaps, and an impact where there is one."""
    for side, (colour, style) in GAPS.items():
        gap = path[f"{side}_gap_m"]
        axes.plot(path["time_s"], gap.clip(lower=0), style, color=colour, linewidth=1.2)
        if row["outcome"] in {side, "both"}:
            # The last moment before contact is what the record has.
            at_s = float(path["time_s"].iloc[int(gap.argmin())])
            axes.plot(at_s, 0, "X", color=colour, markersize=8, clip_on=False, zorder=5)
            speed = row[f"{side}_impact_mps"]
            axes.annotate(f"{speed:.1f} m/s", (at_s, 0), (3, 6), textcoords="offset points", fontsize=7, color=colour)


def _verdict(row: dict[Any, Any], survives: bool) -> str:
    return said(row["outcome"], survives) + (" (late)" if row["late"] is True else "")


def _title(run: Run) -> str:
    asked = configuration(run)
    return (
        f"CCRB with a car behind ({asked['simulator']} simulator): {operating_point(asked)}, "
        f"N = {asked['n_skills']}, L = {asked['tokens_per_skill']}"
    )


def _legend() -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    names = {"lead": "lead; gap to it", "ego": "ego", "rear": "car behind; gap to it"}
    lines: list[object] = [
        Line2D([], [], color=colour, linestyle=style, label=names[car]) for car, (colour, style) in LOOKS.items()
    ]
    lines.append(Line2D([], [], color="#555555", marker="|", linestyle="", label="a token arrives"))
    return lines + [Patch(label=_CAPTIONS[name], **look) for name, look in _PHASES.items()]
