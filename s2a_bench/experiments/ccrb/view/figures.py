"""The figures of a CCRB run: the operating point as curves (figure 3 of the paper), phase diagram."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from s2a_bench.experiments.ccrb.rows import TRAJECTORIES
from s2a_bench.experiments.ccrb.view.outcomes import (
    configuration,
    has,
    origin_notes,
    rate_span,
    rollouts_of,
    scenes_of,
    share_of,
    token_times_s,
)
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.labels import NAIVE, ORDERING, PAPER, ahead, law, operating_point, outcome_label
from s2a_bench.store.requests import SKILLS
from s2a_bench.writers.figures import new_figure, shade_plane
from s2a_bench.writers.style import WIDE_IN

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

CAR_STYLES: Final[dict[str, tuple[str, Literal["-", "--", ":"]]]] = {
    "lead": ("#0072B2", "--"),
    "ego": ("#000000", "-"),
    "rear": ("#D55E00", ":"),
}
_SIDES: Final = {"front": ("#0072B2", "--"), "rear": ("#D55E00", ":")}
_PHASES: Final[dict[str, dict[str, Any]]] = {
    "waiting": {"facecolor": "#EEEEEE", "linewidth": 0},
    "acting": {"facecolor": "#BFE3D5", "edgecolor": "white", "linewidth": 0.6},
    "gap": {"facecolor": "white", "edgecolor": "#999999", "hatch": "//////", "linewidth": 0},
}
_FIRST: Final[dict[str, Any]] = {"color": "#555555", "linestyle": "-.", "linewidth": 0.6}
_CAPTIONS: Final = {"waiting": "no skill yet", "acting": "a skill runs", "gap": "stall: no skill is valid"}
_REST_MPS: Final = 0.1
_AFTER_S: Final = 1.0
REGIONS: Final = {
    "paper": ("the paper's ordering", "#009E73"),
    "others": ("both others have an impact, in other ways", "#8FD3BE"),
    NAIVE: ("only naive has an impact", "#E69F00"),
    "wait": ("only wait-then-act has an impact", "#56B4E9"),
    "nobody": ("nobody has an impact", "#F3F3F3"),
    "all": ("all three have an impact", "#444444"),
    "mine": ("stream-to-act has an impact, another does not", "#CC79A7"),
}

_POINT: Final[dict[str, Any]] = {
    "color": "white",
    "linestyle": "",
    "marker": "*",
    "markeredgecolor": "black",
    "markersize": 9,
}


def build_scenario(run: StoredRun) -> Figure:
    """Draw positions, speeds and gaps over time at the operating point, a column a policy, and name its roll-out."""
    found = rollouts_of(run, "point")
    survives, rows = bool(found["follower_survives"].all()), found.to_dict("records")
    paths = {row["policy"]: _path(run, row) for row in rows}
    skills = dict(list(run.table(SKILLS).groupby("cell", sort=False)))
    settings, beside = configuration(run), rollouts_of(run, "rollout").set_index("cell")
    title = (
        f"CCRB with a car behind ({settings['simulator']} simulator{', closed loop' * (len(beside) > 0)}): "
        f"{operating_point(settings)}, N = {settings['n_skills']}, L = {settings['tokens_per_skill']}"
    )
    figure = new_figure(4.5, (title, *origin_notes(run)), WIDE_IN)
    grid = figure.subplots(3, len(rows), squeeze=False, sharex=True, sharey="row")
    until_s = max(float(path["time_s"].iloc[-1]) for path in paths.values())
    for column, row in enumerate(rows):
        path, cell = paths[row["policy"]], row["cell"]
        above = grid[0, column]
        verdict = f"{row['policy']}: {_verdict(row, survives)}"
        if cell in beside.index:
            verdict += f"\nroll-out: {_verdict(beside.loc[cell].to_dict(), survives)}"
        above.set_title(verdict, loc="left", pad=3)
        edge, token_s = above.get_xaxis_transform(), token_times_s(run, cell)  # the lower edge, whatever the positions
        for axes in grid[:, column]:
            _shade(axes, path, skills[cell])
            axes.axvline(token_s[0], **_FIRST)
            axes.set_xlim(0, until_s)
        _draw_cars(above, path, "position_m")
        above.plot(token_s, [0.04] * len(token_s), "|", color="#555555", markersize=5, transform=edge)
        _draw_cars(grid[1, column], path, "speed_kmh")
        _draw_gaps(grid[2, column], path, row)
        grid[2, column].set_xlabel("time from the request (s)")
    for axes, label in zip(grid[:, 0], ("position (m)", "speed (km/h)", "gap (m)"), strict=True):
        axes.set_ylabel(label)
    grid[2, 0].set_ylim(bottom=0)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=4)
    return figure


def ccrb_figures(run: StoredRun) -> dict[str, Callable[[], Figure]]:
    builders: dict[str, Callable[[], Figure]] = {"scenario": partial(build_scenario, run)}
    if has(run, "phase"):
        builders["phase"] = partial(build_phase, run)
    return builders


def _path(run: StoredRun, row: dict[Any, Any]) -> pd.DataFrame:
    """Return a trajectory until the cars rest, the car behind until its impact: times in s, speeds in km/h, gaps."""
    rows = run.table(TRAJECTORIES)
    path: pd.DataFrame = rows[rows["cell"] == row["cell"]].reset_index(drop=True)
    path["time_s"] = path["at_ns"] / 1e9
    for car in CAR_STYLES:
        path[f"{car}_speed_kmh"] = path[f"{car}_speed_mps"] * 3.6
    path["front_gap_m"] = path["lead_position_m"] - path["ego_position_m"]
    path["rear_gap_m"] = path["ego_position_m"] - path["rear_position_m"]
    moving = path[[f"{car}_speed_mps" for car in CAR_STYLES]].max(axis=1) > _REST_MPS
    rest_s = float(path["time_s"][moving].max()) if moving.any() else 0.0
    shown = path["time_s"] <= rest_s + _AFTER_S
    path = path.loc[shown].copy()
    touched: Any = path.index[path["rear_gap_m"] <= 0] if row["outcome"] in {"rear", "both"} else []
    if len(touched):
        columns = [name for name in path.columns if name.startswith("rear_")]
        path.loc[touched[0] + 1 :, columns] = float("nan")
    return path


def _shade(axes: Axes, path: pd.DataFrame, skills: pd.DataFrame) -> None:
    first, last = float(skills["start_ns"].iloc[0]) / 1e9, float(path["time_s"].iloc[-1])
    axes.axvspan(0, min(first, last), zorder=0, **_PHASES["waiting"])
    for skill in skills.to_dict("records"):
        start, end, stall = (skill[f"{name}_ns"] / 1e9 for name in ("start", "end", "stall"))
        if start < last:
            axes.axvspan(start, min(end, last), zorder=0, **_PHASES["acting"])
        if stall > 0 and start - stall < last:
            axes.axvspan(start - stall, min(start, last), zorder=0, **_PHASES["gap"])


def _draw_cars(axes: Axes, path: pd.DataFrame, what: str) -> None:
    for car, (colour, style) in CAR_STYLES.items():
        axes.plot(path["time_s"], path[f"{car}_{what}"], style, color=colour, linewidth=1.2)


def _draw_gaps(axes: Axes, path: pd.DataFrame, row: dict[Any, Any]) -> None:
    for side, (colour, style) in _SIDES.items():
        gap = path[f"{side}_gap_m"]
        axes.plot(path["time_s"], gap.clip(lower=0), style, color=colour, linewidth=1.2)
        if row["outcome"] in {side, "both"}:
            # The last moment before contact is what the record has.
            at_s = float(path["time_s"].iloc[int(gap.argmin())])
            axes.plot(at_s, 0, "X", color=colour, markersize=8, clip_on=False, zorder=5)
            speed = row[f"{side}_impact_mps"]
            axes.annotate(f"{speed:.1f} m/s", (at_s, 0), (3, 6), textcoords="offset points", fontsize=7, color=colour)


def _verdict(row: dict[Any, Any], survives: bool) -> str:
    return outcome_label(row["outcome"], survives) + (" (late)" if row["late"] is True else "")


def _legend() -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    names = {"lead": "lead; gap to it", "ego": "ego", "rear": "car behind; gap to it"}
    lines: list[object] = [
        Line2D([], [], color=colour, linestyle=style, label=names[car]) for car, (colour, style) in CAR_STYLES.items()
    ]
    lines.append(Line2D([], [], color="#555555", marker="|", linestyle="", label="a token arrives"))
    lines.append(Line2D([], [], label="the first token", **_FIRST))
    return lines + [Patch(label=_CAPTIONS[name], **style) for name, style in _PHASES.items()]


def region_of(scenes: pd.DataFrame) -> list[str]:
    """Return the region of each scenario, a key of `REGIONS`."""
    named = []
    for row in scenes.to_dict("records"):
        hit = tuple(row[name] != "none" for name in PAPER)
        if row["paper"]:
            named.append("paper")
        elif hit[2]:
            named.append("all" if all(hit) else "mine")
        else:
            named.append({(True, True): "others", (True, False): NAIVE, (False, True): "wait"}.get(hit[:2], "nobody"))
    return named


def build_phase(run: StoredRun) -> Figure:
    """Draw the regions of the plane, a panel a gap behaviour."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    settings = configuration(run)
    plan = f"N = {settings['n_skills']}, L = {settings['tokens_per_skill']}"
    scene = f"{ahead(settings)}, reaction {settings['reaction_s']:g} s, {plan}"
    survives = scenes_of(run, "phase", GAPS[0])["survives"]
    check = f" It survives an ego with fast tokens at {survives.mean():.0%}." if survives.notna().all() else ""
    caption = (
        "Who has an impact, for each behaviour of the ego while no skill is valid",
        f"{scene[0].upper()}{scene[1:]}.",
        f"{ORDERING} The percentages are its shares of the plane.",
        f"Rear: {law(settings)}.{check}",
        "EMULATED: tokens come evenly.",
    )
    figure = new_figure(4.6, caption, WIDE_IN)
    grid = figure.subplots(2, -(-len(GAPS) // 2), sharex=True, sharey=True)
    seen: set[str] = set()
    for axes, gap in zip(grid.flat, GAPS, strict=True):
        scenes = scenes_of(run, "phase", gap)
        seen |= _draw_panel(axes, scenes, settings, run)
        share, span = share_of(scenes, "paper").value, rate_span(run, gap, at_point=True)
        where = f"R {span[0]:.1f}\N{EN DASH}{span[1]:.1f}" if span else "no R"
        at = f"at {settings['rear_gap_m']:g} m: {where}"
        axes.set_title(f"{gap}: the paper's ordering {share:.1%}, {at}", loc="left")
    for axes in grid[-1]:
        axes.set_xlabel("R (tokens/s)")
    for axes in grid[:, 0]:
        axes.set_ylabel("rear gap (m)")
    handles: list[object] = [
        Patch(facecolor=colour, edgecolor="#888888", linewidth=0.4, label=label)
        for name, (label, colour) in REGIONS.items()
        if name in seen
    ]
    handles.append(Line2D([], [], label="operating point", **_POINT))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _draw_panel(axes: Axes, scenes: pd.DataFrame, settings: dict[str, Any], run: StoredRun) -> set[str]:
    from matplotlib.colors import ListedColormap

    named = region_of(scenes)
    order = list(REGIONS)
    codes = scenes.assign(code=[order.index(name) for name in named])
    colours = ListedColormap([colour for _, colour in REGIONS.values()])
    shade_plane(axes, codes, "tokens_per_s", "rear_gap_m", "code", cmap=colours, vmin=-0.5, vmax=len(order) - 0.5)
    slowest, fastest = scenes["tokens_per_s"].min(), scenes["tokens_per_s"].max()
    axes.set_xscale("log")
    ticks = [rate for rate in (0.5, 1, 2, 3, 4, 6, 8, 12, 20, 35) if slowest <= rate <= fastest]
    axes.set_xticks(ticks, [f"{rate:g}" for rate in ticks])
    axes.set_xticks([], minor=True)
    rate = run.manifest["boards"][0]["tokens_per_s"]
    axes.plot(rate, settings["rear_gap_m"], **_POINT)
    return set(np.unique(named))
