"""Building blocks of figures: one column wide, rows named on the left, numbers beside them, PNG and PDF.

A figure has a caption, a title and notes in plain text, that is not drawn: the page, LaTeX, notebooks and
``captions.md`` set it below. One line with the origin of the numbers is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.errors import StoreError
from s2a_bench.provenance import joined
from s2a_bench.stats import Floats
from s2a_bench.store.files import why
from s2a_bench.text import one_line
from s2a_bench.writers.style import GREY, PAGE_IN, WIDTH_IN, paper_column
from s2a_bench.writers.tables import markdown_text, number, required

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

WIDE_SPREAD = 10
"""A larger ratio of the extremes needs a logarithmic axis, or a panel of shares."""

LINE_CHARS = 62
"""Characters of 7 point that fit into one column."""

WHISKERS = "Bars are medians; whiskers reach from the 10th to the 90th percentile."


def new_figure(height_in: float, caption: Iterable[str], width_in: float = WIDTH_IN) -> Figure:
    """Make a figure on Agg, without pyplot and its global state; ``caption`` has a title and notes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(PAGE_IN if on_page() else width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    figure.set_label("\n".join(map(one_line, caption)))
    return figure


def on_page() -> bool:
    """Return True if figures are as wide as a page of HTML, where panels fit beside one another."""
    import matplotlib as mpl

    return bool(mpl.rcParams["figure.figsize"][0] == PAGE_IN)


def caption_of(figure: Figure) -> tuple[str, ...]:
    """Return a figure's title and notes; the last note of a `marked` one is the origin of its numbers."""
    return tuple(str(figure.get_label()).split("\n"))


def markdown_caption(figure: Figure) -> str:
    title, *notes = map(markdown_text, caption_of(figure))
    return " ".join((f"{title}.", *notes))


def name_rows(axes: Axes, names: list[str]) -> None:
    """Name the rows on the left, the first one on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)


def write_beside(axes: Axes, place: float, text: str) -> None:
    """Write a number to the right of the axes, where no bar can cover it."""
    axes.text(1.02, place, text, transform=axes.get_yaxis_transform(), verticalalignment="center")


def draw_over(axes: Axes, x: Sequence[float], y: Sequence[float], style: str, label: str = "") -> None:
    """Draw a dark line with a white edge, visible on a bar of any colour."""
    from matplotlib.patheffects import withStroke

    edge = [withStroke(linewidth=2.4, foreground="white")]
    axes.plot(x, y, style, color="black", linewidth=0.9, markersize=4, path_effects=edge, label=label)


def logarithmic(axes: Axes, spread: float) -> None:
    """Make the x axis logarithmic with plain numbers: 0.1, 1, 10; also 2 and 5 if there is space."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if spread < WIDE_SPREAD**2 else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def shade_plane(axes: Axes, points: pd.DataFrame, x: str, y: str, value: str, **style: Any) -> QuadMesh:
    """Shade the plane of two columns by a third, a rectangle around each point."""
    table = points.pivot_table(index=y, columns=x, values=value)
    xs, ys, values = (each.to_numpy(dtype="float64") for each in (table.columns, table.index, table))
    return axes.pcolormesh(xs, ys, values, shading="nearest", rasterized=True, **style)


@dataclass(frozen=True, slots=True)
class Bar:
    """One row of `build_bars`; ``whisker`` has both ends, None if they are unknown."""

    name: str
    value: float
    whisker: tuple[float, float] | None
    text: str
    colour: str = GREY

    @classmethod
    def of(cls, name: str, values: Floats, colour: str) -> Bar:
        import numpy as np

        low, median, high = np.percentile(values, (10, 50, 90)).tolist()
        return cls(name, median, (low, high), number(median), colour)


def build_bars(
    caption: Iterable[str], bars: Sequence[Bar], label: str, others: str = "", *, scaled: bool = False
) -> Figure:
    """Draw one row a bar, from zero; ``others`` is the legend of the grey ones.

    If ``scaled``, values that spread by more than `WIDE_SPREAD` become points on a logarithmic axis.
    """
    from matplotlib.patches import Patch

    figure = new_figure(0.75 + 0.34 * len(bars) + (0.2 if others else 0), caption)
    axes = figure.subplots()
    values = [bar.value for bar in bars]
    wide = scaled and max(values) > WIDE_SPREAD * min(values)
    for place, bar in enumerate(bars):
        if wide:
            axes.plot(
                bar.value, place, "o", markersize=5, color=bar.colour, markeredgecolor="black", markeredgewidth=0.5
            )
        else:
            axes.barh(place, bar.value, 0.62, color=bar.colour, edgecolor="black", linewidth=0.5)
        if bar.whisker:
            draw_over(axes, bar.whisker, (place, place), "|-")
        write_beside(axes, place, bar.text)
    name_rows(axes, [bar.name for bar in bars])
    if wide:
        logarithmic(axes, max(values) / min(values))
        axes.set_xlim(min(values) / 2, max(values) * 2)
        axes.grid(visible=True, axis="x", linewidth=0.3, color="#DDDDDD")
    else:
        axes.set_xlim(left=0)
    axes.set_xlabel(label)
    if others:
        handle = Patch(facecolor=GREY, edgecolor="black", linewidth=0.5, label=others)
        figure.legend(handles=[handle], loc="outside lower left")
    return figure


def build_distribution(
    caption: Iterable[str],
    lines: Mapping[str, tuple[Floats, tuple[str, str]]],
    of: str,
    label: str,
    columns: int = 2,
) -> Figure:
    """Draw empirical distributions: name -> values, colour and line style."""
    figure = new_figure(2.35 + 0.14 * -(-len(lines) // 2), caption)
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


_DAY = len("2026-11-23")


def source_line(runs: Sequence[StoredRun]) -> str:
    """Return one line with the origin of the numbers of runs, the hosts and the days."""
    hosts = [str(run.manifest.get("host", "")) for run in runs]
    days = [str(run.manifest.get("started", ""))[:_DAY] for run in runs]
    origin = joined(run.origins for run in runs).brief
    return " · ".join(filter(None, dict.fromkeys((origin, *hosts, *days))))


def marked(build: Callable[[], Figure], *runs: StoredRun) -> Figure:
    """Build a figure of runs; the origin of its numbers is drawn above it in one line, and ends its caption."""
    figure = build()
    line = figure.suptitle(source_line(runs), x=0.01, horizontalalignment="left", color="#444444", parse_math=False)
    too_wide = line.get_window_extent().width / (0.95 * figure.bbox.width)
    line.set_fontsize(float(line.get_fontsize()) / max(1.0, too_wide))
    figure.set_label("\n".join((*caption_of(figure), joined(run.origins for run in runs).line)))
    return figure


def save(folder: Path, builders: Mapping[str, Callable[[], Figure]], noted: Callable[[str], Any] = nullcontext) -> None:
    """Write each figure as .png and .pdf, and ``captions.md``; raises StoreError, ValueError for one not `marked`."""
    captions = []
    try:
        folder.mkdir(exist_ok=True)
        for name, build in builders.items():
            with noted(f"figure {name}"), paper_column():
                figure = build()
                required(name, figure.get_suptitle())
                for suffix in ("png", "pdf"):
                    figure.savefig(folder / f"{name}.{suffix}")
                captions.append(f"**{name}**: {markdown_caption(figure)}\n")
        (folder / "captions.md").write_text("\n".join(captions), encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {folder}: {why(error, folder)}; the samples are kept") from error
