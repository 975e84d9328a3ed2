"""What every figure is made with: one column wide, rows named on the left, numbers beside them, PNG and PDF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import StoreError
from s2a_bench.provenance import ORIGIN
from s2a_bench.store.room import why
from s2a_bench.writers.style import WIDTH_IN, paper_column
from s2a_bench.writers.tables import required

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE_SPREAD = 10
"""Values that spread by more than this factor get a logarithmic axis, or a panel of shares."""

LINE_CHARS = 62
"""As many characters of 7 point fit into one column."""


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


def marked(figure: Figure, provenance: str) -> Figure:
    """Write below a figure's title where its numbers come from, and return it; it grows by the lines' height."""
    import textwrap

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
