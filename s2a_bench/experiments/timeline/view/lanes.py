"""The shown plans of a run as lanes of the page: a panel a board and granularity, a lane a policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from s2a_bench.experiments.timeline.view.cells import Timelines, panels, seconds
from s2a_bench.experiments.timeline.view.figures import policy_colours
from s2a_bench.writers.lanes import Lane, LaneBar, LanePanel, Lanes

MOST_PANELS: Final = 60
"""Limit on the size of the page; the tables and CSV files have all."""
BARS: Final = "Bars are skills, dashed boxes stalls, the dashed line is S0, long ticks are complete skills."


def page_lanes(cells: Sequence[Timelines]) -> Lanes:
    """Return the lanes of the cells that have a plan."""
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
        _complete_s(cells[0]) if shared else (),
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
        _complete_s(cell) if own_tokens else (),
    )


def _complete_s(cell: Timelines) -> tuple[float, ...]:
    return tuple(cell.skills["arrival_ns"].to_numpy(dtype="float64") / 1e9)
