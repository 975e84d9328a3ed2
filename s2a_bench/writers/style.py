"""The style of figures: one paper column wide, safe for the colour-blind (Okabe and Ito), never colour alone."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, Final

from s2a_bench.transport import declared_transport
from s2a_bench.transport.pipeline import without

WIDTH_IN: Final = 3.5
"""One column of a two-column paper."""

WIDE_IN: Final = 7.16
"""Both columns."""

PAGE_IN: Final = 8.0
"""A page of HTML."""

STALL_STYLE: Final[dict[str, Any]] = {"facecolor": "white", "edgecolor": "#444444", "hatch": "//////", "linewidth": 0.4}

GREY: Final = "#BBBBBB"
"""The colour of a reference's values."""

GROUP_FILLS: Final = {
    "capture": ("#56B4E9", ""),
    "encode": ("#E69F00", "////"),
    "pack": ("#F0E442", ".."),
    "network": ("#0072B2", "\\\\\\\\"),
    "ingest": ("#999999", "xxxx"),
    "parse": ("#CC79A7", "----"),
    "decode": ("#D55E00", "||||"),
    "queue": ("#000000", ""),
    "inference": ("#666666", "++++"),
    "server": ("#666666", "oo"),
    "return": ("#009E73", "xxxx"),
}
"""Group of stages -> colour and hatch."""

RESIDUAL_FILL: Final = ("#FFFFFF", "//////")

_OTHER_STYLES: Final = (("#56B4E9", "-."), ("#F0E442", "--"), ("#999999", ":"), ("#666666", "-"))


def ink_on(colour: str) -> str:
    """Return a colour of text that is legible on ``#RRGGBB``."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return "white" if 0.299 * red + 0.587 * green + 0.114 * blue < 128 else "black"  # noqa: PLR2004 - half way


def cell_styles(cells: Mapping[str, tuple[str, str]]) -> dict[str, tuple[str, str]]:
    """Return name -> colour and line style, for cells given as name -> (transport, variant).

    A cell has the style that its transport declares, in every figure of every run, dotted if its name has a payload. A
    cell with other options, or of an unknown transport, gets one of the other styles.
    """
    styles: dict[str, tuple[str, str]] = {}
    for name, (transport, variant) in cells.items():
        plain, style = without(name, "payload"), declared_transport(transport).style
        if "?" not in plain and variant in style:
            styles[name] = style[variant] if plain == name else (style[variant][0], ":")
    others = [name for name in cells if name not in styles]
    return styles | {name: _OTHER_STYLES[place % len(_OTHER_STYLES)] for place, name in enumerate(others)}


def paper_column(width_in: float = WIDTH_IN) -> AbstractContextManager[None]:
    """Draw with 7 and 8 point text, thin lines, and fonts that a publisher accepts (Type 42); or for a page of HTML."""
    import matplotlib as mpl

    settings: Any = {  # newer stubs list every key
        "figure.figsize": (width_in, width_in),
        "font.family": "DejaVu Sans",
        "font.size": 7,
        "axes.labelsize": 8,
        "axes.titlesize": 7,
        "figure.titlesize": 7,
        "legend.fontsize": 7,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "axes.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "hatch.linewidth": 0.5,
        "lines.linewidth": 1.3,
        "legend.frameon": False,
        "legend.handlelength": 2.2,
        "pdf.fonttype": 42,
        "savefig.dpi": 300,
    }
    return mpl.rc_context(settings)
