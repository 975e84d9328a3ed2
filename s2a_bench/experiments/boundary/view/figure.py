"""Figure 2 of the paper: the stall-free region of naive execution over tokens per skill and rate; PNG and PDF."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.experiments.boundary.view.tables import grid_of, is_random, marks_of
from s2a_bench.writers.figures import LINE_CHARS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from s2a_bench.store.run import Run

_FREE, _BETWEEN, _STALLS = "#009E73", "#F0E442", "#D55E00"
_SHADE: Final = 0.3
_INK: Final = "#222222"


def build_boundary(run: Run) -> Figure:
    """Draw the lines R = L / T_nom and R = L / T_min, what trials found, and the boards.

    Without jitter regions are shaded by the formula and every trial is a mark; with jitter P(a plan stalls) is shaded.
    """
    figure = new_figure(3.5, _title(run))
    axes = figure.subplots()
    nominal = grid_of(run, "t_nom")
    low, high = float(nominal["tokens_per_s"].min()), float(nominal["tokens_per_s"].max())
    most = int(nominal["tokens_per_skill"].max())
    axes.set_yscale("log")
    axes.set_xlim(0.5, most + 0.5)
    axes.set_ylim(low, high)
    lines = {name: float(grid_of(run, name)["duration_s"].iloc[0]) for name in ("t_nom", "t_min")}
    tokens = np.linspace(0.5, most + 0.5, 200)
    if is_random(run):
        _shade_shares(figure, axes, run)
    else:
        _shade_regions(axes, tokens, lines, low, high)
        _mark_trials(axes, run)
    looks = {
        "t_nom": ("-", r"$R = L\,/\,T_\mathrm{nom}$ (naive as it runs)"),
        "t_min": ("--", r"$R = L\,/\,T_\mathrm{min}$ (the paper's line)"),
    }
    for name, duration_s in lines.items():
        style, label = looks[name]
        axes.plot(tokens, tokens / duration_s, style, color="black", label=label)
    _mark_boards(axes, run)
    axes.set_xticks(range(1, most + 1))
    axes.yaxis.set_major_formatter(lambda value, _place: f"{value:g}")
    axes.set_xlabel("tokens per skill, L")
    axes.set_ylabel("rate, R (tokens/s)")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.0)
    return figure


def boundary_figures(run: Run) -> dict[str, Callable[[], Figure]]:
    """Return the figure by its file's name."""
    return {"boundary": lambda: build_boundary(run)}


def _shade_regions(axes: Axes, tokens: np.ndarray, lines: dict[str, float], low: float, high: float) -> None:
    """Shade what the formula says, and write it into the regions."""
    nominal, least = tokens / lines["t_nom"], tokens / lines["t_min"]
    axes.fill_between(tokens, least, high, color=_FREE, alpha=_SHADE, linewidth=0)
    axes.fill_between(tokens, nominal, least, color=_BETWEEN, alpha=_SHADE, linewidth=0)
    axes.fill_between(tokens, low, nominal, color=_STALLS, alpha=_SHADE, linewidth=0)
    box = {"facecolor": "white", "alpha": 0.85, "linewidth": 0, "pad": 1.5}
    axes.text(0.03, 0.68, "stall-free", transform=axes.transAxes, color=_INK, bbox=box)
    axes.text(0.97, 0.04, "naive stalls", transform=axes.transAxes, color=_INK, ha="right", bbox=box)


def _mark_trials(axes: Axes, run: Run) -> None:
    """Mark every trial of naive at T_nom."""
    points = grid_of(run, "t_nom")
    for marker, label, chosen in (
        ("o", "trial: no stall", points[points["p_stall"] == 0]),
        ("x", "trial: stalls", points[points["p_stall"] > 0]),
    ):
        face = "none" if marker == "o" else _INK
        axes.scatter(
            chosen["tokens_per_skill"],
            chosen["tokens_per_s"],
            7,
            marker=marker,
            facecolors=face,
            edgecolors=_INK if marker == "o" else None,
            linewidths=0.5,
            label=label,
        )


def _shade_shares(figure: Figure, axes: Axes, run: Run) -> None:
    """Shade the share of plans that stall, as executed at T_nom."""
    table = grid_of(run, "t_nom").pivot_table(index="tokens_per_s", columns="tokens_per_skill", values="p_stall")
    mesh = axes.pcolormesh(
        table.columns.to_numpy(dtype="float64"),
        table.index.to_numpy(dtype="float64"),
        table.to_numpy(dtype="float64"),
        cmap="Oranges",
        vmin=0,
        vmax=1,
        shading="nearest",
        rasterized=True,
    )
    figure.colorbar(mesh, ax=axes, label="P(a plan stalls), naive at $T_\\mathrm{nom}$", pad=0.02)


def _mark_boards(axes: Axes, run: Run) -> None:
    """Draw a line a board, with its granularities: filled where naive is stall-free at T_nom."""
    for title, rate, points in marks_of(run):
        nominal = points[points["duration"] == "t_nom"]
        axes.axhline(rate, color=_INK, linewidth=0.5, linestyle=":")
        box = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1}
        axes.annotate(
            f"{title}, {rate:g}",
            (1, rate),
            (-2, 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="right",
            va="bottom",
            fontsize=6,
            color=_INK,
            bbox=box,
        )
        for free, face in ((True, _INK), (False, "white")):
            chosen = nominal[nominal["stall_free"] == free]
            axes.plot(
                chosen["tokens_per_skill"],
                chosen["tokens_per_s"],
                "s",
                markersize=4.5,
                color=_INK,
                markerfacecolor=face,
                markeredgewidth=0.9,
            )


def _title(run: Run) -> str:
    """Return what is drawn, and what it is made of."""
    asked = run.manifest["configuration"]
    t_nom_s = asked["t_nom_s"]
    facts = [f"N = {asked['n_skills']}", f"$T_\\mathrm{{nom}}$ = {t_nom_s:g} s"]
    facts += [f"$T_\\mathrm{{min}}$ = {asked['t_min'] * t_nom_s:g} s"]
    facts += [f"{asked['plans']} plans a point" if is_random(run) else "tokens come evenly"]
    lines = ["Stall-free region of naive execution", ", ".join(facts)]
    lines += [f"jitter {asked['jitter']}"] if is_random(run) else []
    if any(board["origin"] == "paper" for board in run.manifest["boards"]):
        lines.append(
            "Squares: boards at the paper's rates (not measured here), filled where the formula says stall-free"
        )
    return "\n".join(textwrap.fill(line, LINE_CHARS + 14 * ("$" in line)) for line in lines)
