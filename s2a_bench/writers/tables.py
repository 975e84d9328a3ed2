"""Text tables: their cells as text, rounded to three digits, and the whole as Markdown or LaTeX."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from s2a_bench.text import one_line

if TYPE_CHECKING:
    from typing_extensions import Self

    from s2a_bench.stats import Ratio, Summary


ABSENT = "\N{EN DASH}"
"""Stands where a cell does not have a stage or a ratio."""


EMULATED, DUMMY, ECHO = "emulated", "dummy weights", "echo engine"
PAPERS, ASSUMED, DRAWN = "paper's claim", "assumption", "drawn, not measured"
"""Labels that several experiments give to their runs."""


class Note(str):
    """A note below a table. Its labels mark the run wherever runs are listed; a plain string is a note without any."""

    __slots__ = ("labels",)
    labels: tuple[str, ...]

    def __new__(cls, text: str, *labels: str) -> Self:
        """Label a text."""
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


def to_latex(table: TextTable) -> str:
    """Write a table as a LaTeX ``tabular`` for the package booktabs; title and notes are comments.

    Where its numbers come from stands as its last line, which is printed with it.
    """
    lines = [f"% {one_line(note)}" for note in (table.title, *table.footer)]
    lines += [f"\\begin{{tabular}}{{{'l' * table.left}{'r' * (len(table.header) - table.left)}}}", "\\toprule"]
    lines += [_latex_row(table.header), "\\midrule"]
    for place, row in enumerate(table.rows):
        lines += [*(["\\midrule"] if place in table.rules else []), _latex_row(row)]
    origin = f"\\par{{\\footnotesize {_latex(table.provenance)}}}"
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", origin]) + "\n"


def _decimals(value: float) -> int:
    """Return how many decimals leave three digits."""
    for places, limit in ((0, 99.95), (1, 9.995), (2, 0.9995)):
        if abs(value) >= limit:
            return places
    return 3


def _latex_row(row: tuple[str, ...]) -> str:
    """Write one row of a LaTeX table."""
    # A booktabs row that opens with a bracket would be read as an option of the row before it.
    texts = map(_latex, row)
    return " & ".join(f"{{{text}}}" if text.startswith("[") else text for text in texts) + " \\\\"


def _latex(text: str) -> str:
    """Write a text so that LaTeX sets it."""
    from s2a_bench.writers.latex import escape  # it builds on the tables of this module

    return escape(text)
