"""The phase diagram: over rate and rear gap, who has an impact under which policy; a panel a gap behaviour."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.experiments.ccrb.view.outcomes import configuration, rate_span_here, scenes_of, share_of
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.words import ORDERING, ahead, law
from s2a_bench.writers.figures import LINE_CHARS, new_figure
from s2a_bench.writers.style import WIDTH_IN

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run

WIDE_IN: Final = 7.16
REGIONS: Final = {
    "paper": ("the paper's ordering", "#009E73"),
    "others": ("both others have an impact, in other ways", "#8FD3BE"),
    "naive": ("only naive has an impact", "#E69F00"),
    "wait": ("only wait-then-act has an impact", "#56B4E9"),
    "nobody": ("nobody has an impact", "#FFFFFF"),
    "all": ("all three have an impact", "#444444"),
    "mine": ("stream-to-act has an impact, another does not", "#CC79A7"),
}


def region_of(scenes: pd.DataFrame) -> list[str]:
    """Name the region of each scenario."""
    named = []
    for row in scenes.to_dict("records"):
        hit = tuple(row[name] != "none" for name in ("naive", "wait-then-act", "stream-to-act"))
        if row["paper"]:
            named.append("paper")
        elif hit[2]:
            named.append("all" if all(hit) else "mine")
        else:
            named.append({(True, True): "others", (True, False): "naive", (False, True): "wait"}.get(hit[:2], "nobody"))
    return named


def build_phase(run: Run) -> Figure:
    """Draw a panel a gap behaviour, the operating point marked, the findings above each."""
    from matplotlib.patches import Patch

    asked = configuration(run)
    chars = round(LINE_CHARS * WIDE_IN / WIDTH_IN)
    scene = (
        f"{ahead(asked)}, reaction {asked['reaction_s']:g} s, N = {asked['n_skills']}, L = {asked['tokens_per_skill']}"
    )
    survives = scenes_of(run, "phase", GAPS[0])["survives"]
    check = f" It survives an ego with fast tokens at {survives.mean():.0%}." if survives.notna().all() else ""
    lines = [
        f"Who has an impact? {scene[0].upper()}{scene[1:]}. {ORDERING}",
        f"Rear: {law(asked)}.{check} EMULATED: tokens come evenly.",
    ]
    figure = new_figure(2.9, "\n".join(textwrap.fill(line, chars) for line in lines), WIDE_IN)
    grid = figure.subplots(1, len(GAPS), sharex=True, sharey=True)
    seen: set[str] = set()
    for axes, gap in zip(grid, GAPS, strict=True):
        scenes = scenes_of(run, "phase", gap)
        seen |= _draw_panel(axes, scenes, asked, run)
        share = share_of(scenes, "paper").value
        axes.set_title(f"{gap}: {share:.1%} paper's ordering\n{_here(run, gap, asked)}", loc="left")
        axes.set_xlabel("R (tokens/s)")
    grid[0].set_ylabel("rear gap (m)")
    handles: list[object] = [
        Patch(facecolor=colour, edgecolor="#888888", linewidth=0.4, label=label)
        for name, (label, colour) in REGIONS.items()
        if name in seen
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _draw_panel(axes: Axes, scenes: pd.DataFrame, asked: dict[str, Any], run: Run) -> set[str]:
    """Colour the plane by region."""
    from matplotlib.colors import ListedColormap

    named = region_of(scenes)
    order = list(REGIONS)
    codes = scenes.assign(code=[order.index(name) for name in named])
    table = codes.pivot_table(index="rear_gap_m", columns="tokens_per_s", values="code")
    rates = table.columns.to_numpy(dtype="float64")
    axes.pcolormesh(
        rates,
        table.index.to_numpy(dtype="float64"),
        table.to_numpy(dtype="float64"),
        cmap=ListedColormap([colour for _, colour in REGIONS.values()]),
        vmin=-0.5,
        vmax=len(order) - 0.5,
        shading="nearest",
        rasterized=True,
    )
    axes.set_xscale("log")
    ticks = [rate for rate in (0.5, 1, 2, 3, 4, 6, 8, 12, 20, 35) if rates[0] <= rate <= rates[-1]]
    axes.set_xticks(ticks, [f"{rate:g}" for rate in ticks])
    axes.set_xticks([], minor=True)
    rate = run.manifest["boards"][0]["tokens_per_s"]
    axes.plot(rate, asked["rear_gap_m"], "*", color="white", markeredgecolor="black", markersize=9)
    return set(np.unique(named))


def _here(run: Run, gap: str, asked: dict[str, Any]) -> str:
    """Say at which rates it holds at the operating point's rear gap."""
    span = rate_span_here(run, gap)
    where = f"R {span[0]:.1f}\N{EN DASH}{span[1]:.1f}" if span else "no R"
    return f"at {asked['rear_gap_m']:g} m: {where}"
