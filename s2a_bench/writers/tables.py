"""Text tables: their cells as text, rounded to three digits, and the whole as Markdown or for a terminal."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from s2a_bench.stats import summary_of
from s2a_bench.text import one_line, visible

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import RenderableType
    from typing_extensions import Self

    from s2a_bench.stats import Ratio, Summary


ABSENT = "\N{EN DASH}"
"""Stands where a cell does not have a stage or a ratio."""

MEAN_SD = "mean ± sd"

EMULATED, DUMMY = "emulated", "dummy weights"
PAPERS, ASSUMED, DRAWN = "paper's claim", "assumption", "drawn, not measured"
"""Labels that several experiments give to their runs."""


class Note(str):
    """A note below a table. Its labels mark the run wherever runs are listed; a plain string is a note without any."""

    __slots__ = ("labels",)
    labels: tuple[str, ...]

    def __new__(cls, text: str, *labels: str) -> Self:
        note = super().__new__(cls, text)
        note.labels = labels
        return note

    def sentence(self) -> Note:
        """Return it as a sentence: a capital first, a full stop last."""
        return Note(f"{self[0].upper()}{self[1:]}.", *self.labels)


@dataclass(frozen=True, slots=True)
class TextTable:
    """One table: ``left`` columns of names, then columns of numbers; ``rules`` are the rows that a line precedes.

    ``notes`` are strings, or `Note` where they bear labels. ``provenance`` says in one line where the numbers come
    from (`Origins.line`); without it a table is not written to a file.
    """

    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    left: int
    rules: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()
    provenance: str = ""

    @classmethod
    def grouped(
        cls,
        title: str,
        header: Iterable[str],
        groups: Iterable[Iterable[tuple[str, ...]]],
        left: int,
        notes: Iterable[str] = (),
        *,
        once: int = 0,
    ) -> TextTable:
        """Lay out groups of rows with a line between them, the first ``once`` names in a group's first row alone."""
        rows: list[tuple[str, ...]] = []
        rules = set()
        for group in groups:
            rules.add(len(rows))
            rows += [(*([""] * once if place else row[:once]), *row[once:]) for place, row in enumerate(group)]
        return cls(title, tuple(header), rows, left, frozenset(rules - {0}), tuple(notes))

    @property
    def footer(self) -> tuple[str, ...]:
        """Return notes and provenance; raises ValueError where nobody said where the numbers come from."""
        return (*self.notes, required(self.title, self.provenance))


def required(title: str, provenance: str) -> str:
    """Return a provenance; raises ValueError where there is none: a bug of who made the table or figure."""
    if not provenance:
        raise ValueError(f"'{title}' does not say where its numbers come from; give it a provenance")
    return provenance


def number(value: float) -> str:
    """Write a time in ms, or a ratio, with three digits; never more than three decimals."""
    return f"{value:.{_decimals(value)}f}"


def mean_sd(summary: Summary) -> str:
    """Write mean ± standard deviation with the decimals of the mean."""
    places = _decimals(summary.mean)
    return f"{summary.mean:.{places}f}" + ("" if summary.sd is None else f" ± {summary.sd:.{places}f}")


def entries(values: NDArray[np.float64], *statistics: str) -> list[str]:
    """Write statistics of values, those of `Summary` by their names, or `MEAN_SD`; absent where there are no values."""
    found = summary_of(values)
    if found is None:
        return [ABSENT] * len(statistics)
    return [mean_sd(found) if name == MEAN_SD else number(getattr(found, name)) for name in statistics]


def interval(ratio: Ratio | None) -> str:
    """Write a ratio with its interval."""
    if ratio is None or ratio.value is None:
        return ABSENT
    if ratio.low is None or ratio.high is None:
        return number(ratio.value)
    places = _decimals(ratio.value)
    return f"{ratio.value:.{places}f} [{ratio.low:.{places}f}, {ratio.high:.{places}f}]"


def to_markdown(table: TextTable) -> str:
    """Write a table as Markdown, its title and notes around it."""
    rule = ["---"] * table.left + ["---:"] * (len(table.header) - table.left)
    header, *rows = (tuple(map(markdown_text, row)) for row in (table.header, *table.rows))
    lines = ["| " + " | ".join(row) + " |" for row in (header, tuple(rule), *rows)]
    return "\n".join([f"**{markdown_text(table.title)}**", "", *lines, "", *map(markdown_text, table.footer)]) + "\n"


_MARKED = re.compile(r"[\\|*<]|(?<=\])(?=\()")


def markdown_text(text: str) -> str:
    """Return a text on one line in which Markdown finds no cell, emphasis, tag or link."""
    return _MARKED.sub(lambda found: f"\\{found[0]}", one_line(text))


def _decimals(value: float) -> int:
    for places, limit in ((0, 99.95), (1, 9.995), (2, 0.9995)):
        if abs(value) >= limit:
            return places
    return 3


_WIDTH = 100
"""Columns of the terminal that is planned for."""


def lay_out(table: TextTable) -> RenderableType:
    """Turn a table into one for the terminal: long headers broken, the gaps narrowed where that makes it fit."""
    from rich import box
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    header = [*table.header[: table.left], *(_broken(name) for name in table.header[table.left :])]
    lines = [[*name.split("\n"), *column] for name, column in zip(header, zip(*table.rows, strict=True), strict=False)]
    natural = sum(max(map(len, column)) for column in lines)
    gap = 1 if natural + 2 * (len(lines) - 1) <= _WIDTH else 0
    shown = Table(
        title=Text(one_line(table.title)),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, gap, 0, 0),
        pad_edge=False,
    )
    for place, name in enumerate(header):
        shown.add_column(Text(visible(name)), justify="left" if place < table.left else "right", no_wrap=True)
    for place, row in enumerate(table.rows):
        if place in table.rules:
            shown.add_section()
        shown.add_row(*(Text(one_line(text)) for text in row))
    return Padding(shown, (0, 0, 1, 0))


def _broken(name: str) -> str:
    if name.startswith("ratio to "):
        return name.replace("ratio to ", "ratio to\n").replace("?", "?\n")
    return name.replace("/", "/\n") if " " not in name else name.replace(" infer", "\ninfer")
