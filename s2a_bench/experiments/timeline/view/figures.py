"""Figure 5 of the paper: each policy's timeline as tokens come, a panel a board and granularity; the page's lanes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.timeline.view.cells import Timelines, origin_notes, panels, seconds, timelines_of
from s2a_bench.policy import POLICIES
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes
from s2a_bench.writers.style import STALL_STYLE, WIDE_IN, WIDTH_IN, ink_on

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

_LEGEND_COLUMNS: Final = {WIDTH_IN: 3, WIDE_IN: 6}
_OTHERS: Final = ("#56B4E9", "#CC79A7", "#D55E00", "#999999")
_VISIBLE_NS: Final = 20_000_000
"""Shorter stalls and stretches are rounding or jitter, and too narrow to see."""
_LANE: Final = 0.7
MOST_PANELS: Final = 60
"""Limit on the size of the page; the tables and CSV files have all."""
BARS: Final = "Bars are skills, dashed boxes stalls, the dashed line is S0, long ticks are complete skills."


def policy_colours(policies: Sequence[str]) -> dict[str, str]:
    """Return a colour for every policy, the one that it declares if there is one."""
    known = {name: colour for name, made in POLICIES.loaded() if (colour := getattr(made, "colour", ""))}
    others = [name for name in policies if name not in known]
    return known | {name: _OTHERS[place % len(_OTHERS)] for place, name in enumerate(others)}


def build_timelines(run: StoredRun, cells: Sequence[Timelines]) -> Figure:
    """Draw the shown plan of every cell: boards side by side, granularities below one another, policies as lanes.

    ``cells`` share plan length and T_nom. Every panel has a time axis: boards differ by orders of magnitude.
    """
    groups = dict(panels(cells))
    titles = list(dict.fromkeys(setting[0] for setting in groups))
    lengths = list(dict.fromkeys(setting[1] for setting in groups))
    policies = list(dict.fromkeys(cell.policy for cell in cells))
    colours = policy_colours(policies)
    width_in = WIDTH_IN if len(titles) == 1 else WIDE_IN
    lanes = len(policies) + 1
    columns = _LEGEND_COLUMNS[width_in]
    handles = _legend(cells)
    foot_in = 0.55 + 0.17 * -(-len(handles) // columns)
    figure = new_figure(foot_in + len(lengths) * (0.42 + 0.15 * lanes), _caption(run, cells), width_in)
    grid = figure.subplots(len(lengths), len(titles), squeeze=False)
    for row, tokens in enumerate(lengths):
        for column, board in enumerate(titles):
            axes = grid[row, column]
            group = next((group for setting, group in groups.items() if setting[:2] == (board, tokens)), None)
            if group is None:
                axes.set_axis_off()
                continue
            _draw_panel(axes, group, colours, names=column == 0)
            rate = f"{group[0].about('tokens_per_s'):g} tokens/s"
            head = "" if row else f"{board if rate in board else f'{board}, {rate}'}\n"
            axes.set_title(f"{head}L = {tokens} tokens/skill", loc="left", pad=2)
            if row == len(lengths) - 1:
                axes.set_xlabel("time from the request (s)")
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    return figure


def _draw_panel(axes: Axes, cells: Sequence[Timelines], colours: dict[str, str], *, names: bool) -> None:
    """Draw one setting: tokens at the top if all policies share them, else above each policy's skills."""
    shared = len({cell.about("request_id") for cell in cells}) == 1
    end_s = max(cell.moment_s("end_s") for cell in cells)
    if shared:
        _draw_tokens(axes, cells[0], 0.35, -0.35)
    for lane, cell in enumerate(cells, start=1):
        _draw_skills(axes, cell, lane, colours[cell.policy], end_s)
        if not shared:
            _draw_tokens(axes, cell, lane - _LANE / 2, lane - 0.5)
        safe_s = cell.moment_s("safe_start_s")
        axes.vlines(
            safe_s, 0.5 if shared and lane == 1 else lane - 0.5, lane + 0.5, "black", (0, (2, 1.5)), linewidth=0.9
        )
    labels = (["tokens"] if shared else []) + [cell.policy for cell in cells]
    first = 0 if shared else 1
    axes.set_yticks(range(first, first + len(labels)), labels if names else [""] * len(labels))
    axes.set_ylim(len(cells) + 0.55, first - 0.55)
    axes.tick_params(axis="y", length=0)
    axes.set_xlim(0, end_s * 1.02)


def timeline_figures(run: StoredRun) -> dict[str, Callable[[], Figure]]:
    """Return every figure by its file's name, one for each plan length and T_nom."""
    cells = [cell for cell in timelines_of(run) if len(cell.skills)]
    shapes = list(dict.fromkeys(cell.setting[2:] for cell in cells))
    builders: dict[str, Callable[[], Figure]] = {}
    for n_skills, t_nom_s in shapes:
        name = "timeline" if len(shapes) == 1 else f"timeline_N{n_skills}_T{t_nom_s:g}"
        same = [cell for cell in cells if cell.setting[2:] == (n_skills, t_nom_s)]
        builders[name] = partial(build_timelines, run, same)
    return builders


def _draw_skills(axes: Axes, cell: Timelines, lane: int, colour: str, end_s: float) -> None:
    """Draw one lane: a line until the start, then stalls and skills, paler beyond their planned duration."""
    skills = cell.skills.to_dict("records")
    axes.hlines(lane, 0, cell.moment_s("start_s"), "#BBBBBB", linewidth=0.8)
    for skill in skills:
        start, end, stall, nominal = (skill[f"{name}_ns"] / 1e9 for name in ("start", "end", "stall", "nominal"))
        if skill["stall_ns"] > _VISIBLE_NS:
            axes.barh(lane, stall, _LANE, start - stall, zorder=3, **STALL_STYLE)
        axes.barh(lane, end - start, _LANE, start, color=colour, edgecolor="white", linewidth=0.4, label="skill")
        if (end - start - nominal) * 1e9 > _VISIBLE_NS:
            axes.barh(lane, end - start - nominal, _LANE, start + nominal, color="white", alpha=0.5, linewidth=0)
        if end - start > 0.03 * end_s:  # wide enough for its number
            axes.text(
                start + min(end - start, nominal) / 2,
                lane,
                str(skill["index"] + 1),
                color=ink_on(colour),
                fontsize=5,
                ha="center",
                va="center",
            )


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
        Line2D([], [], color="black", linewidth=0.9, linestyle=(0, (2, 1.5)), label="$S_0$"),
    ]
    if any((cell.skills["stall_ns"] > _VISIBLE_NS).any() for cell in cells):
        handles.append(Patch(label="stall", **STALL_STYLE))
    longer_ns = (cell.skills["end_ns"] - cell.skills["start_ns"] - cell.skills["nominal_ns"] for cell in cells)
    if any((each > _VISIBLE_NS).any() for each in longer_ns):
        handles.append(Patch(facecolor="#B5B5B5", linewidth=0, label="stretched (paler)"))
    return handles


def _caption(run: StoredRun, cells: Sequence[Timelines]) -> tuple[str, ...]:
    n_skills, t_nom_s = cells[0].setting[2:]
    what = f"Execution timelines: N = {n_skills} skills, T_nom = {t_nom_s:g} s"
    if (plans := max(cell.n for cell in cells)) > 1:
        what += f"; plan 1 of {plans}"
    return (what, *origin_notes(run, cells))


def page_lanes(cells: Sequence[Timelines]) -> Lanes:
    """Return a panel a board and granularity, a lane a policy, of the cells that have a plan."""
    shown = [cell for cell in cells if len(cell.skills)]
    colours = policy_colours(list(dict.fromkeys(cell.policy for cell in shown)))
    groups = list(panels(shown))
    built = [_panel(setting, group, colours) for setting, group in groups[:MOST_PANELS]]
    return Lanes(built, BARS, left_out=len(groups) - len(built))


def _panel(setting: tuple[str, int, int, float], cells: Sequence[Timelines], colours: dict[str, str]) -> LanePanel:
    title, tokens, n_skills, t_nom_s = setting
    shared = len({cell.about("request_id") for cell in cells}) == 1
    end_s = max(cell.moment_s("end_s") for cell in cells) * 1.02
    rate = f"{cells[0].about('tokens_per_s'):g} tokens/s"
    board = title if rate in title else f"{title}, {rate}"
    plans = f"; plan 1 of {cells[0].n}" if cells[0].n > 1 else ""
    return LanePanel(
        f"{board}: L = {tokens}, N = {n_skills}, T_nom = {t_nom_s:g} s{plans}",
        end_s,
        [_lane(cell, colours[cell.policy], own_tokens=not shared) for cell in cells],
        tuple(cells[0].token_s) if shared else (),
        tuple(cells[0].complete_s) if shared else (),
    )


def _lane(cell: Timelines, colour: str, *, own_tokens: bool) -> Lane:
    bars = []
    for skill in cell.skills.to_dict("records"):
        start, end, stall, arrival = (skill[f"{name}_ns"] / 1e9 for name in ("start", "end", "stall", "arrival"))
        name = f"skill {skill['index'] + 1}" + (f" {skill['text']}" if skill["text"] else "")
        if stall > 0:
            span = f"{seconds(start - stall)} to {seconds(start)} s"
            text = f"{cell.policy}: stall of {seconds(stall)} s before {name}, {span}"
            bars.append(LaneBar("stall", start - stall, stall, text))
        stalled = f", after a stall of {seconds(stall)} s" if stall > 0 else ", no stall before it"
        text = (
            f"{cell.policy}: {name} arrives at {seconds(arrival)} s, runs {seconds(start)} to {seconds(end)} s{stalled}"
        )
        bars.append(LaneBar("skill", start, end - start, text))
    stalls, stall_s = int(cell.rows["stalls"].iloc[0]), cell.moment_s("stall_s")
    summary = f"starts {seconds(cell.moment_s('start_s'))} s, ends {seconds(cell.moment_s('end_s'))} s, "
    summary += f"{stalls} stalls, {seconds(stall_s)} s" if stall_s else "no stalls"
    return Lane(
        cell.policy,
        colour,
        bars,
        cell.moment_s("start_s"),
        summary,
        cell.moment_s("safe_start_s"),
        tuple(cell.token_s) if own_tokens else (),
        tuple(cell.complete_s) if own_tokens else (),
    )
