"""Figures drawn once: as SVG that may stand in a page beside others, and as PDF for a paper."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from s2a_bench.writers.style import WIDTH_IN, paper_column

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Drawn:
    """One figure: SVG to be put into HTML, and PDF where it was asked for.

    ``alt`` is its title; a ``wide`` one takes both columns of a paper.
    """

    svg: str
    alt: str
    wide: bool
    pdf: bytes | None


def draw(name: str, builders: Mapping[str, Callable[[], Figure]], *, pdf: bool) -> dict[str, Drawn]:
    """Build each figure once; ``name`` makes the ids of its parts differ from those of all other figures."""
    import matplotlib as mpl

    found = {}
    for place, (figure_name, build) in enumerate(builders.items()):
        prefix = f"{re.sub(r'[^A-Za-z0-9]', '-', name)}-{place}-"
        with paper_column(), mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": prefix}):
            figure = build()
            found[figure_name] = Drawn(
                _svg(figure, prefix), _alt(figure), figure.get_figwidth() > WIDTH_IN, _pdf(figure) if pdf else None
            )
    return found


def _svg(figure: Figure, prefix: str) -> str:
    out = io.StringIO()
    figure.savefig(out, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = out.getvalue()
    return inline(text[text.index("<svg") :], prefix)


def inline(svg: str, prefix: str) -> str:
    """Make an SVG fit for HTML: no namespaces, metadata and styles (they would be the page's), ids like no others."""
    svg = re.sub(r"<!--.*?-->\s*|<(metadata|style)\b.*?</\1>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg)
    svg = svg.replace("xlink:href=", "href=")
    return re.sub(r'(\bid="|href="#|url\(#)', lambda found: found[1] + prefix, svg)


def _pdf(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="pdf", metadata={"CreationDate": None})
    return out.getvalue()


def _alt(figure: Figure) -> str:
    """Return the title in one line, its mathematics as plain as it goes."""
    title = " ".join(figure.get_suptitle().split())
    return re.sub(r"\\mathrm\{(\w+)\}", r"\1", title.replace("$", ""))
