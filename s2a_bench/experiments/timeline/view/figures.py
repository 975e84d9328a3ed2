"""Figure 5 of the paper: each policy's timeline as tokens come, a panel a board and granularity; the page's lanes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.timeline.view.cells import Panel, Timelines, panels, seconds
from s2a_bench.policy import POLICIES
from s2a_bench.writers.figures import new_figure, on_page
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes
from s2a_bench.writers.style import STALL_STYLE, WIDE_IN, WIDTH_IN, ink_on

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.requests import SkillRow

_OTHERS: Final = ("#56B4E9", "#CC79A7", "#D55E00", "#999999")
_VISIBLE_NS: Final = 20_000_000
"""Shorter stalls and stretches are rounding or jitter, and too narrow to see."""
_LANE: Final = 0.7
_DASHES: Final = (0, (2, 1.5))
MOST_PANELS: Final = 60
"""Limit on the size of the page; the tables and CSV files have all."""
BARS: Final = "Bars are skills, dashed boxes stalls, the dashed line is S0, long ticks are complete skills."


def policy_colours(cells: Iterable[Timelines] = ()) -> dict[str, str]:
    """Return a colour for every policy, the one that it declares if there is one."""
    policies = dict.fromkeys(cell.policy for cell in cells)
    known = {name: colour for name, made in POLICIES.loaded() if (colour := getattr(made, "colour", ""))}
    others = [name for name in policies if name not in known]
    return known | {name: _OTHERS[place % len(_OTHERS)] for place, name in enumerate(others)}


def timeline_figures(cells: Iterable[Timelines], notes: Sequence[str]) -> dict[str, Callable[[], Figure]]:
    """Return every figure by its file's name, one for each plan length and T_nom; ``notes`` are of the captions."""
    by_shape: dict[tuple[int, float], list[Timelines]] = {}
    for cell in cells:
        if cell.skills:
            by_shape.setdefault(cell.shape, []).append(cell)
    names = ["timeline"] if len(by_shape) == 1 else [f"timeline_N{n}_T{t_nom_s:g}" for n, t_nom_s in by_shape]
    return {name: partial(build_timelines, same, notes) for name, same in zip(names, by_shape.values(), strict=True)}


def build_timelines(cells: Sequence[Timelines], notes: Iterable[str]) -> Figure:
    """Draw the shown plan of every cell: boards side by side, granularities below one another, policies as lanes.

    ``cells`` share plan length and T_nom. Every panel has a time axis: boards differ by orders of magnitude.
    """
    every = panels(cells)
    lengths = list(dict.fromkeys(panel.first.tokens_per_skill for panel in every))
    titles = list(dict.fromkeys(panel.first.title for panel in every))
    places = {(panel.first.tokens_per_skill, panel.first.title): panel for panel in every}
    colours = policy_colours(cells)
    width_in = WIDTH_IN if len(titles) == 1 else WIDE_IN
    columns = 3 if width_in == WIDTH_IN and not on_page() else 6
    n_skills, t_nom_s = cells[0].shape
    caption = f"Execution timelines: N = {n_skills} skills, T_nom = {t_nom_s:g} s{_of_plans(cells)}", *notes
    handles = _legend(cells)
    foot_in = 0.55 + 0.17 * -(-len(handles) // columns)
    lanes = len({cell.policy for cell in cells}) + 1
    figure = new_figure(foot_in + len(lengths) * (0.42 + 0.15 * lanes), caption, width_in)
    grid = figure.subplots(len(lengths), len(titles), squeeze=False)
    for row, tokens in enumerate(lengths):
        for column, title in enumerate(titles):
            axes, panel = grid[row, column], places.get((tokens, title))
            if panel is None:
                axes.set_axis_off()
                continue
            _draw_panel(axes, panel, colours, names=column == 0)
            head = "" if row else f"{panel.board}\n"
            axes.set_title(f"{head}L = {tokens} tokens/skill", loc="left", pad=2)
            if row == len(lengths) - 1:
                axes.set_xlabel("time from the request (s)")
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    return figure


def _of_plans(cells: Sequence[Timelines]) -> str:
    plans = max(map(len, cells))
    return f"; plan 1 of {plans}" if plans > 1 else ""


def _draw_panel(axes: Axes, panel: Panel, colours: dict[str, str], *, names: bool) -> None:
    """Draw one setting: tokens at the top if all policies share them, else above each policy's skills."""
    end_s, labels = panel.end_s, [cell.policy for cell in panel.cells]
    first = 1
    if panel.shared:
        _draw_tokens(axes, panel.shared, 0.35, -0.35)
        first, labels = 0, ["tokens", *labels]
    for lane, cell in enumerate(panel.cells, start=1):
        _draw_skills(axes, cell, lane, colours[cell.policy], end_s)
        if not panel.shared:
            _draw_tokens(axes, cell, lane - _LANE / 2, lane - 0.5)
        axes.vlines(cell.first.safe_start_ns / 1e9, lane - 0.5, lane + 0.5, "black", _DASHES, linewidth=0.9)
    axes.set_yticks(range(first, first + len(labels)), labels if names else [""] * len(labels))
    axes.set_ylim(len(panel.cells) + 0.55, first - 0.55)
    axes.tick_params(axis="y", length=0)
    axes.set_xlim(0, end_s * 1.02)


def _draw_skills(axes: Axes, cell: Timelines, lane: int, colour: str, end_s: float) -> None:
    """Draw one lane: a line until the start, then stalls and skills, paler beyond their planned duration."""
    axes.hlines(lane, 0, cell.first.start_ns / 1e9, "#BBBBBB", linewidth=0.8)
    for skill in cell.skills:
        start, taken, stall = skill.start_ns / 1e9, (skill.end_ns - skill.start_ns) / 1e9, skill.stall_ns / 1e9
        planned = skill.nominal_ns / 1e9
        if skill.stall_ns > _VISIBLE_NS:
            axes.barh(lane, stall, _LANE, start - stall, zorder=3, **STALL_STYLE)
        axes.barh(lane, taken, _LANE, start, color=colour, edgecolor="white", linewidth=0.4, label="skill")
        if _stretch_ns(skill) > _VISIBLE_NS:
            axes.barh(lane, taken - planned, _LANE, start + planned, color="white", alpha=0.5, linewidth=0)
        if taken > 0.03 * end_s:  # wide enough for its number
            middle, name = start + min(taken, planned) / 2, str(skill.index + 1)
            axes.text(middle, lane, name, color=ink_on(colour), fontsize=5, ha="center", va="center")


def _stretch_ns(skill: SkillRow) -> int:
    return skill.end_ns - skill.start_ns - skill.nominal_ns


def _draw_tokens(axes: Axes, cell: Timelines, low: float, high: float) -> None:
    middle = (low + high) / 2
    axes.vlines(cell.token_s, low, middle, "#888888", linewidth=0.4)
    axes.vlines(cell.complete_s, low, high, "black", linewidth=0.8)


def _legend(cells: Sequence[Timelines]) -> list[object]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    tick: dict[str, Any] = {"linestyle": "none", "marker": "|"}
    handles: list[object] = [
        Line2D([], [], color="#888888", markersize=4, label="token", **tick),
        Line2D([], [], color="black", markersize=7, label="skill complete", **tick),
        Line2D([], [], color="#BBBBBB", linewidth=0.8, label="not started"),
        Line2D([], [], color="black", linewidth=0.9, linestyle=_DASHES, label="$S_0$"),
    ]
    skills = [skill for cell in cells for skill in cell.skills]
    if any(skill.stall_ns > _VISIBLE_NS for skill in skills):
        handles.append(Patch(label="stall", **STALL_STYLE))
    if any(_stretch_ns(skill) > _VISIBLE_NS for skill in skills):
        handles.append(Patch(facecolor="#B5B5B5", linewidth=0, label="stretched (paler)"))
    return handles


def page_lanes(cells: Iterable[Timelines]) -> Lanes:
    """Return a panel a board and granularity, a lane a policy, of the cells that have a plan."""
    shown = [cell for cell in cells if cell.skills]
    colours, every = policy_colours(shown), panels(shown)
    built = [_panel(panel, colours) for panel in every[:MOST_PANELS]]
    return Lanes(built, BARS, left_out=len(every) - len(built))


def _panel(panel: Panel, colours: dict[str, str]) -> LanePanel:
    plan, plans = panel.first, _of_plans(panel.cells)
    return LanePanel(
        f"{panel.board}: L = {plan.tokens_per_skill}, N = {plan.n_skills}, T_nom = {plan.t_nom_s:g} s{plans}",
        panel.end_s * 1.02,
        [_lane(cell, colours[cell.policy], own_tokens=not panel.shared) for cell in panel.cells],
        tuple(panel.shared.token_s) if panel.shared else (),
        tuple(panel.shared.complete_s) if panel.shared else (),
    )


def _lane(cell: Timelines, colour: str, *, own_tokens: bool) -> Lane:
    bars = []
    for skill in cell.skills:
        start, end, stall = skill.start_ns / 1e9, skill.end_ns / 1e9, skill.stall_ns / 1e9
        name = f"skill {skill.index + 1}" + (f" {skill.text}" if skill.text else "")
        stalled = ", no stall before it"
        if stall > 0:
            span = f"{seconds(start - stall)} to {seconds(start)} s"
            text = f"{cell.policy}: stall of {seconds(stall)} s before {name}, {span}"
            bars.append(LaneBar("stall", start - stall, stall, text))
            stalled = f", after a stall of {seconds(stall)} s"
        runs = f"arrives at {seconds(skill.arrival_ns / 1e9)} s, runs {seconds(start)} to {seconds(end)} s"
        bars.append(LaneBar("skill", start, end - start, f"{cell.policy}: {name} {runs}{stalled}"))
    plan = cell.first
    stalls = f"{plan.stalls} stalls, {seconds(plan.stall_ns / 1e9)} s" if plan.stall_ns else "no stalls"
    return Lane(
        cell.policy,
        colour,
        bars,
        plan.start_ns / 1e9,
        f"starts {seconds(plan.start_ns / 1e9)} s, ends {seconds(plan.end_ns / 1e9)} s, {stalls}",
        plan.safe_start_ns / 1e9,
        tuple(cell.token_s) if own_tokens else (),
        tuple(cell.complete_s) if own_tokens else (),
    )
