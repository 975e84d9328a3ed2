"""What every figure is made with: one column wide, rows named on the left, numbers beside them, PNG and PDF."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import StoreError
from s2a_bench.provenance import ORIGIN
from s2a_bench.store.files import why
from s2a_bench.writers.style import GREY, WIDTH_IN, paper_column
from s2a_bench.writers.tables import required

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

WIDE_SPREAD = 10
"""Values that spread by more than this factor get a logarithmic axis, or a panel of shares."""

LINE_CHARS = 62
"""As many characters of 7 point fit into one column."""


def wrapped(lines: Iterable[str], width_in: float = WIDTH_IN) -> str:
    """Break lines to a figure's width; of mathematics less is drawn than written."""
    chars = round(LINE_CHARS * width_in / WIDTH_IN)
    return "\n".join(textwrap.fill(line, chars + 14 * ("$" in line), break_on_hyphens=False) for line in lines)


def new_figure(height_in: float, title: str, width_in: float = WIDTH_IN) -> Figure:
    """Make a figure that draws itself with Agg, without pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in + 0.13 * title.count("\n")), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.01, horizontalalignment="left")
    return figure


def name_rows(axes: Axes, names: list[str]) -> None:
    """Put the names to the left, the first one on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)


def write_beside(axes: Axes, place: int, text: str) -> None:
    """Write a number to the right of the axes, where no bar can cover it."""
    axes.text(1.02, place, text, transform=axes.get_yaxis_transform(), verticalalignment="center")


def logarithmic(axes: Axes, spread: float) -> None:
    """Make the x axis logarithmic with plain numbers: 0.1, 1, 10; 2 and 5 as well where there is room."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if spread < WIDE_SPREAD**2 else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


@dataclass(frozen=True, slots=True)
class Bar:
    """One row of `build_bars`; ``sd`` is None where it is not known."""

    name: str
    mean: float
    sd: float | None
    text: str
    colour: str = GREY


def build_bars(title: str, bars: Sequence[Bar], label: str, paper: str = "", *, scaled: bool = False) -> Figure:
    """Draw mean ± sd, a row a bar, from zero; ``paper`` explains the grey ones.

    If ``scaled``, bars too far apart for one scale become points on a logarithmic axis.
    """
    from matplotlib.patches import Patch

    figure = new_figure(0.75 + 0.34 * len(bars) + (0.2 + 0.125 * paper.count("\n") if paper else 0), title)
    axes = figure.subplots()
    means = [bar.mean for bar in bars]
    wide = scaled and max(means) > WIDE_SPREAD * min(means)
    for place, bar in enumerate(bars):
        if wide:
            axes.plot(
                bar.mean, place, "o", markersize=5, color=bar.colour, markeredgecolor="black", markeredgewidth=0.5
            )
        else:
            axes.barh(place, bar.mean, 0.62, color=bar.colour, edgecolor="black", linewidth=0.5)
        if bar.sd is not None:
            low = min(bar.sd, bar.mean * 0.999)  # a time or a rate is above zero, whatever the standard deviation is
            axes.errorbar(bar.mean, place, xerr=[[low], [bar.sd]], color="black", capsize=2, linewidth=0.8)
        write_beside(axes, place, bar.text)
    name_rows(axes, [bar.name for bar in bars])
    if wide:
        logarithmic(axes, max(means) / min(means))
        axes.set_xlim(min(means) / 2, max(means) * 2)
        axes.grid(visible=True, axis="x", linewidth=0.3, color="#DDDDDD")
    else:
        axes.set_xlim(left=0)
    axes.set_xlabel(label)
    if paper:
        handle = Patch(facecolor=GREY, edgecolor="black", linewidth=0.5, label=paper)
        figure.legend(handles=[handle], loc="outside lower left")
    return figure


def build_distribution(
    title: str, lines: Mapping[str, tuple[NDArray[np.float64], tuple[str, str]]], of: str, label: str, columns: int = 2
) -> Figure:
    """Draw empirical distributions: name -> values, colour and line style; logarithmic if they spread widely."""
    figure = new_figure(2.35 + 0.14 * -(-len(lines) // 2), title)
    axes = figure.subplots()
    for name, (values, (colour, style)) in lines.items():
        axes.ecdf(values, label=name, color=colour, linestyle=style)
    low, high = min(values.min() for values, _ in lines.values()), max(values.max() for values, _ in lines.values())
    if low > 0 and high > WIDE_SPREAD * low:
        logarithmic(axes, high / low)
    axes.set_ylim(0, 1.02)
    axes.set_ylabel(f"share of {of}")
    axes.set_xlabel(label)
    axes.grid(visible=True, linewidth=0.3, color="#DDDDDD")
    figure.legend(loc="outside lower center", ncols=columns, columnspacing=1.2)
    return figure


def marked(figure: Figure, provenance: str) -> Figure:
    """Write below a figure's title where its numbers come from, and return it; it grows by the lines' height."""
    lines = textwrap.wrap(provenance, round(LINE_CHARS * figure.get_figwidth() / WIDTH_IN))
    figure.set_figheight(figure.get_figheight() + 0.13 * len(lines))
    figure.suptitle("\n".join((figure.get_suptitle(), *lines)), x=0.01, horizontalalignment="left")
    return figure


def save(folder: Path, builders: Mapping[str, Callable[[], Figure]]) -> list[Path]:
    """Build each figure and write it as ``<name>.png`` and ``<name>.pdf``; raises StoreError where that fails.

    Raises ValueError for a figure that does not say where its numbers come from.
    """
    written = []
    try:
        folder.mkdir(exist_ok=True)
        for name, build in builders.items():
            with paper_column():
                figure = build()
                required(name, figure.get_suptitle().partition(ORIGIN)[1])
                for suffix in ("png", "pdf"):
                    path = folder / f"{name}.{suffix}"
                    figure.savefig(path)
                    written.append(path)
    except OSError as error:
        raise StoreError(f"cannot write {folder}: {why(error, folder)}; the samples are kept") from error
    return written
