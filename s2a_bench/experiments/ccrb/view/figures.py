"""The figures of a CCRB run: the operating point as curves (figure 3 of the paper), phase diagram."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from s2a_bench.experiments.ccrb.rows import TRAJECTORIES
from s2a_bench.experiments.ccrb.view.outcomes import Rollouts, origin_notes, rate_span, share_of
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.labels import NAIVE, ORDERING, PAPER, ahead, law, operating_point
from s2a_bench.writers.figures import new_figure, shade_plane
from s2a_bench.writers.style import WIDE_IN

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Style: TypeAlias = dict[str, Any]
_CARS: Final[dict[str, Style]] = {
    "lead": {"color": "#0072B2", "linestyle": "--", "label": "lead; gap to it"},
    "ego": {"color": "#000000", "linestyle": "-", "label": "ego"},
    "rear": {"color": "#D55E00", "linestyle": ":", "label": "car behind; gap to it"},
}
_TOKEN: Final[Style] = {"color": "#555555", "marker": "|", "linestyle": "", "label": "a token arrives"}
_FIRST: Final[Style] = {"color": "#555555", "linestyle": "-.", "linewidth": 0.6, "label": "the first token"}
_WAITING: Final[Style] = {"facecolor": "#EEEEEE", "linewidth": 0, "label": "no skill yet"}
_ACTING: Final[Style] = {"facecolor": "#BFE3D5", "edgecolor": "white", "linewidth": 0.6, "label": "a skill runs"}
_STALL: Final[Style] = {
    "facecolor": "white",
    "edgecolor": "#999999",
    "hatch": "//////",
    "linewidth": 0,
    "label": "stall: no skill is valid",
}
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

_POINT: Final[Style] = {
    "color": "white",
    "linestyle": "",
    "marker": "*",
    "markeredgecolor": "black",
    "markersize": 9,
    "label": "operating point",
}


@dataclass(frozen=True, slots=True)
class DrivenPlan:
    """One policy at the operating point as it is drawn: times in s from the request, impacts in m/s by side."""

    title: str
    path: pd.DataFrame
    skills: pd.DataFrame
    token_s: Sequence[float]
    impacts: Mapping[str, float]


def ccrb_figures(rollouts: Rollouts) -> dict[str, Callable[[], Figure]]:
    builders: dict[str, Callable[[], Figure]] = {"scenario": lambda: build_scenario(*_scenario(rollouts))}
    if diagram := rollouts.studies.get("phase"):
        at = rollouts.run.manifest["boards"][0]["tokens_per_s"], rollouts.settings["rear_gap_m"]
        builders["phase"] = lambda: build_phase(_phase_caption(diagram, rollouts.settings), diagram, at)
    return builders


def _scenario(rollouts: Rollouts) -> tuple[tuple[str, ...], list[DrivenPlan]]:
    """Return the caption and the data of the operating point's figure."""
    settings, every = rollouts.settings, rollouts.run.table(TRAJECTORIES)
    world = f"{settings['simulator']} simulator" + (", closed loop" if rollouts.beside else "")
    plan = f"N = {settings['n_skills']}, L = {settings['tokens_per_skill']}"
    caption = f"CCRB with a car behind ({world}): {operating_point(settings)}, {plan}", *origin_notes(rollouts)
    plans = []
    for row in rollouts.point:
        title, beside = f"{row.policy}: {row.label}", rollouts.beside.get(row.cell)
        if beside:
            title += f"\nroll-out: {beside.label}"
        speeds = {"front": row.front_impact_mps, "rear": row.rear_impact_mps}
        impacts = {side: speed for side, speed in speeds.items() if speed is not None}
        path = path_of(every[every["cell"] == row.cell], hit_from_behind="rear" in impacts)
        plans.append(DrivenPlan(title, path, rollouts.skills[row.cell].frame, rollouts.token_s(row.cell), impacts))
    return caption, plans


def build_scenario(caption: Sequence[str], plans: Sequence[DrivenPlan]) -> Figure:
    """Draw positions, speeds and gaps over time at the operating point, a column a policy."""
    figure = new_figure(4.5, caption, WIDE_IN)
    grid = figure.subplots(3, len(plans), squeeze=False, sharex=True, sharey="row")
    until_s = max(float(plan.path["time_s"].iloc[-1]) for plan in plans)
    for (above, middle, below), plan in zip(grid.T, plans, strict=True):
        above.set_title(plan.title, loc="left", pad=3)
        for axes in (above, middle, below):
            _shade(axes, plan.path, plan.skills)
            axes.axvline(plan.token_s[0], **_FIRST)
            axes.set_xlim(0, until_s)
        _draw_cars(above, plan.path, "position_m")
        edge = above.get_xaxis_transform()  # the lower edge, whatever the positions
        above.plot(plan.token_s, [0.04] * len(plan.token_s), markersize=5, transform=edge, **_TOKEN)
        _draw_cars(middle, plan.path, "speed_mps", 3.6)
        _draw_gaps(below, plan.path, plan.impacts)
        below.set_xlabel("time from the request (s)")
    for axes, label in zip(grid[:, 0], ("position (m)", "speed (km/h)", "gap (m)"), strict=True):
        axes.set_ylabel(label)
    grid[2, 0].set_ylim(bottom=0)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=4)
    return figure


def path_of(trajectory: pd.DataFrame, *, hit_from_behind: bool) -> pd.DataFrame:
    """Return a trajectory until the cars rest, the car behind until its impact, with times in s, and gaps."""
    path = trajectory.assign(
        time_s=trajectory["at_ns"] / 1e9,
        front_gap_m=trajectory["lead_position_m"] - trajectory["ego_position_m"],
        rear_gap_m=trajectory["ego_position_m"] - trajectory["rear_position_m"],
    )
    moving = (path[[f"{car}_speed_mps" for car in _CARS]] > _REST_MPS).any(axis=1)
    rest_s = float(path["time_s"][moving].max()) if moving.any() else 0.0
    path = path[path["time_s"] <= rest_s + _AFTER_S].reset_index(drop=True)
    touched = path.index[path["rear_gap_m"] <= 0]
    if hit_from_behind and len(touched):
        path.loc[touched[0] + 1 :, ["rear_position_m", "rear_speed_mps", "rear_gap_m"]] = float("nan")
    return path


def _shade(axes: Axes, path: pd.DataFrame, skills: pd.DataFrame) -> None:
    first, last = float(skills["start_ns"].iloc[0]) / 1e9, float(path["time_s"].iloc[-1])
    axes.axvspan(0, min(first, last), zorder=0, **_WAITING)
    for skill in skills.to_dict("records"):
        start, end, stall = (skill[f"{name}_ns"] / 1e9 for name in ("start", "end", "stall"))
        if start < last:
            axes.axvspan(start, min(end, last), zorder=0, **_ACTING)
        if stall > 0 and start - stall < last:
            axes.axvspan(start - stall, min(start, last), zorder=0, **_STALL)


def _draw_cars(axes: Axes, path: pd.DataFrame, column: str, scale: float = 1.0) -> None:
    for car, style in _CARS.items():
        axes.plot(path["time_s"], path[f"{car}_{column}"] * scale, linewidth=1.2, **style)


def _draw_gaps(axes: Axes, path: pd.DataFrame, impacts: Mapping[str, float]) -> None:
    for side, car in (("front", "lead"), ("rear", "rear")):
        gap, colour = path[f"{side}_gap_m"], _CARS[car]["color"]
        axes.plot(path["time_s"], gap.clip(lower=0), linewidth=1.2, **_CARS[car])
        if side in impacts:
            # The last moment before contact is what the record has.
            at_s = float(path["time_s"].iloc[int(gap.argmin())])
            axes.plot(at_s, 0, "X", color=colour, markersize=8, clip_on=False, zorder=5)
            speed = f"{impacts[side]:.1f} m/s"
            axes.annotate(speed, (at_s, 0), (3, 6), textcoords="offset points", fontsize=7, color=colour)


def _legend() -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lines = [Line2D([], [], **style) for style in (*_CARS.values(), _TOKEN, _FIRST)]
    return [*lines, *(Patch(**style) for style in (_WAITING, _ACTING, _STALL))]


def region_of(scenes: pd.DataFrame) -> list[str]:
    """Return the region of each scenario, a key of `REGIONS`."""
    naive, wait, stream = (scenes[policy] != "none" for policy in PAPER)
    cases = {"paper": scenes["paper"], "all": naive & wait & stream, "mine": stream, "others": naive & wait}
    cases |= {NAIVE: naive, "wait": wait}
    regions: list[str] = np.select([*cases.values()], [*cases], "nobody").tolist()
    return regions


def _phase_caption(diagram: Mapping[str, pd.DataFrame], settings: Mapping[str, Any]) -> tuple[str, ...]:
    scene = f"{ahead(settings)}, reaction {settings['reaction_s']:g} s"
    plan = f"N = {settings['n_skills']}, L = {settings['tokens_per_skill']}"
    survives = diagram[GAPS[0]]["survives"]
    check = f" It survives an ego with fast tokens at {survives.mean():.0%}." if survives.notna().all() else ""
    return (
        "Who has an impact, for each behaviour of the ego while no skill is valid",
        f"{scene[0].upper()}{scene[1:]}, {plan}.",
        f"{ORDERING} The percentages are its shares of the plane.",
        f"Rear: {law(settings)}.{check}",
        "EMULATED: tokens come evenly.",
    )


def build_phase(caption: Sequence[str], diagram: Mapping[str, pd.DataFrame], at: tuple[float, float]) -> Figure:
    """Draw the regions of the plane, a panel a gap behaviour; ``at`` is the operating point, R and rear gap."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure = new_figure(4.6, caption, WIDE_IN)
    grid = figure.subplots(2, -(-len(diagram) // 2), sharex=True, sharey=True)
    seen: set[str] = set()
    for axes, (gap, scenes) in zip(grid.flat, diagram.items(), strict=True):
        seen |= _draw_panel(axes, scenes)
        axes.plot(*at, **_POINT)
        share, span = share_of(scenes, "paper").value, rate_span(scenes, at[1])
        where = f"R {span[0]:.1f}\N{EN DASH}{span[1]:.1f}" if span else "no R"
        axes.set_title(f"{gap}: the paper's ordering {share:.1%}, at {at[1]:g} m: {where}", loc="left")
    for axes in grid[-1]:
        axes.set_xlabel("R (tokens/s)")
    for axes in grid[:, 0]:
        axes.set_ylabel("rear gap (m)")
    handles: list[object] = [
        Patch(facecolor=colour, edgecolor="#888888", linewidth=0.4, label=label)
        for name, (label, colour) in REGIONS.items()
        if name in seen
    ]
    handles.append(Line2D([], [], **_POINT))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _draw_panel(axes: Axes, scenes: pd.DataFrame) -> set[str]:
    """Shade the regions of one gap behaviour, and return their names."""
    from matplotlib.colors import ListedColormap

    named, order = region_of(scenes), list(REGIONS)
    codes = scenes.assign(code=[order.index(name) for name in named])
    colours = ListedColormap([colour for _, colour in REGIONS.values()])
    shade_plane(axes, codes, "tokens_per_s", "rear_gap_m", "code", cmap=colours, vmin=-0.5, vmax=len(order) - 0.5)
    slowest, fastest = scenes["tokens_per_s"].min(), scenes["tokens_per_s"].max()
    axes.set_xscale("log")
    ticks = [rate for rate in (0.5, 1, 2, 3, 4, 6, 8, 12, 20, 35) if slowest <= rate <= fastest]
    axes.set_xticks(ticks, [f"{rate:g}" for rate in ticks])
    axes.set_xticks([], minor=True)
    return set(named)
