"""Text tables: entries rounded to three digits, written as Markdown or for a terminal."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from s2a_bench.stats import Floats, Ratio, Summary, summary_of
from s2a_bench.text import one_line, visible

if TYPE_CHECKING:
    from rich.console import RenderableType
    from typing_extensions import Self

ABSENT = "\N{EN DASH}"
"""The entry of an absent stage or ratio."""

MEAN_SD = "mean ± sd"

EMULATED, DUMMY = "emulated", "dummy weights"
PAPERS, ASSUMED, DRAWN = "paper's claim", "assumption", "drawn, not measured"
"""Labels of runs that several experiments use."""


class Note(str):
    """A note below a table. Its labels mark the run in every list of runs; a plain string is a note without labels."""

    __slots__ = ("labels",)
    labels: tuple[str, ...]

    def __new__(cls, text: str, *labels: str) -> Self:
        note = super().__new__(cls, text)
        note.labels = labels
        return note

    def sentence(self) -> Note:
        return Note(f"{self[0].upper()}{self[1:]}.", *self.labels)


@dataclass(frozen=True, slots=True)
class TextTable:
    """One table: ``left`` columns of names, then columns of numbers; a line precedes each row of ``rules``.

    ``cells`` are the cells of the rows, empty if every row is about all of them.
    ``notes`` are strings, or `Note` if they have labels. ``provenance`` is the origin of the numbers in one line
    (`Origins.line`); without it a table cannot be written to a file. A terminal that is too narrow shows ``brief``.
    """

    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    left: int
    rules: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()
    provenance: str = ""
    brief: TextTable | None = None
    cells: tuple[str, ...] = ()

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
        cells: Iterable[str] = (),
    ) -> TextTable:
        """Make a table of groups with a line between them; only a group's first row has the first ``once`` names."""
        rows: list[tuple[str, ...]] = []
        rules = set()
        for group in groups:
            rules.add(len(rows))
            for place, row in enumerate(group):
                names = ("",) * once if place else row[:once]
                rows.append((*names, *row[once:]))
        return cls(title, tuple(header), rows, left, frozenset(rules - {0}), tuple(notes), cells=tuple(cells))

    @property
    def footer(self) -> tuple[str, ...]:
        """Return notes and provenance; raises ValueError if there is no provenance."""
        return (*self.notes, required(self.title, self.provenance))


def required(title: str, provenance: str) -> str:
    """Return a provenance; raises ValueError if it is empty, which is a bug of the caller."""
    if not provenance:
        raise ValueError(f"'{title}' does not say where its numbers come from; give it a provenance")
    return provenance


def number(value: float | None, scale: float = 1) -> str:
    """Format a time in ms, or a ratio, times ``scale``, with three digits and at most three decimals."""
    return ABSENT if value is None else f"{value * scale:.{_decimals(value * scale)}f}"


def mean_sd(summary: Summary) -> str:
    """Format mean ± standard deviation with the decimals of the mean."""
    places = _decimals(summary.mean)
    return f"{summary.mean:.{places}f}" + ("" if summary.sd is None else f" ± {summary.sd:.{places}f}")


def entries(values: Floats, *statistics: str) -> list[str]:
    """Format statistics of values, fields of `Summary` or `MEAN_SD`; `ABSENT` if there are no values."""
    summary = summary_of(values)
    if summary is None:
        return [ABSENT] * len(statistics)
    return [mean_sd(summary) if name == MEAN_SD else number(getattr(summary, name)) for name in statistics]


def median_mean(values: Floats) -> str:
    """Format the median, and mean ± standard deviation in brackets."""
    median, mean = entries(values, "median", MEAN_SD)
    return f"{median} ({mean})" if values.size else ABSENT


def ends_entries(ends: tuple[Floats, Floats], *statistics: str) -> list[str]:
    low, high = (entries(values, *statistics) for values in ends)
    return [f"[{lo}, {hi}]" for lo, hi in zip(low, high, strict=True)]


def interval(ratio: Ratio | None) -> str:
    if ratio is None or ratio.value is None:
        return ABSENT
    if ratio.low is None or ratio.high is None:
        return number(ratio.value)
    places = _decimals(ratio.value)
    return f"{ratio.value:.{places}f} [{ratio.low:.{places}f}, {ratio.high:.{places}f}]"


def to_markdown(table: TextTable) -> str:
    """Return a table as Markdown between its title and its notes."""
    rule = ["---"] * table.left + ["---:"] * (len(table.header) - table.left)
    header, *rows = (tuple(map(markdown_text, row)) for row in (table.header, *table.rows))
    lines = ["| " + " | ".join(row) + " |" for row in (header, tuple(rule), *rows)]
    return "\n".join([f"**{markdown_text(table.title)}**", "", *lines, "", *map(markdown_text, table.footer)]) + "\n"


_MARKED = re.compile(r"[\\|*<]|(?<=\])(?=\()")


def markdown_text(text: str) -> str:
    """Escape a text for one line of Markdown: no cell, emphasis, tag or link."""
    return _MARKED.sub(lambda match: f"\\{match[0]}", one_line(text))


def _decimals(value: float) -> int:
    for places, limit in ((0, 99.95), (1, 9.995), (2, 0.9995)):
        if abs(value) >= limit:
            return places
    return 3


def fits(table: TextTable, width: int) -> bool:
    """Return True if a table fits in ``width`` columns in one block."""
    wide = _widths(table)
    return sum(wide) + len(wide) - 1 <= width


def lay_out(table: TextTable, width: int) -> RenderableType:
    """Return a table for a terminal of ``width`` columns, with all the text of its cells.

    If it is too wide, gaps are narrowed and headers broken, then long names folded; the columns of numbers that still
    do not fit follow in further blocks, each with the names.
    """
    from rich.console import Group
    from rich.text import Text

    blocks = [
        item for columns, wide, gap in _blocks(table, width) for item in (_block(table, columns, wide, gap), Text())
    ]
    return Group(Text(one_line(table.title), "bold"), *blocks)


def _widths(table: TextTable, *, folded: bool = False) -> list[int]:
    """Return the width of each column; if ``folded``, headers of numbers are also broken at spaces."""
    from rich.cells import cell_len

    def lines(place: int, name: str) -> list[str]:
        return re.split(r"\s", name) if folded and place >= table.left else name.split("\n")

    cells = [[one_line(row[place]) for row in table.rows] for place in range(len(table.header))]
    return [
        max(map(cell_len, (*lines(place, name), *column)))
        for place, (name, column) in enumerate(zip(_headings(table), cells, strict=True))
    ]


def _blocks(table: TextTable, width: int) -> Iterator[tuple[list[int], list[int], int]]:
    """Yield the columns of each block, the widths of all columns, and the gap."""
    left, wide, gap = table.left, _widths(table), 2
    if sum(wide) + gap * (len(wide) - 1) > width:
        gap = 1
    if sum(wide) + gap * (len(wide) - 1) > width:
        wide = _widths(table, folded=True)
    if sum(wide) + gap * (len(wide) - 1) > width:
        gap = 2
        _fold_names(table, wide, max(width // 2, width - sum(wide[left:]) - gap * len(wide[left:])) - gap * (left - 1))
    start = sum(wide[:left]) + gap * (left - 1)
    numbers: list[int] = []
    used = start
    for place in range(left, len(wide)):
        wide[place] = min(wide[place], max(width - start - gap, 1))
        if numbers and used + gap + wide[place] > width:
            yield [*range(left), *numbers], wide, gap
            numbers, used = [], start
        numbers.append(place)
        used += gap + wide[place]
    yield [*range(left), *numbers], wide, gap


def _fold_names(table: TextTable, wide: list[int], most: int) -> None:
    """Narrow the columns of names to ``most`` in total, first at spaces, then within words."""
    words = [
        max((len(word) for row in table.rows for word in row[place].split(" ")), default=0)
        for place in range(table.left)
    ]
    while sum(wide[: table.left]) > max(most, table.left):
        loose = [place for place, least in enumerate(words) if wide[place] > least]
        wide[max(loose or range(table.left), key=lambda place: wide[place])] -= 1


def _block(table: TextTable, columns: Sequence[int], wide: Sequence[int], gap: int) -> RenderableType:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, gap - 1, 0, 0), pad_edge=False)
    names = _headings(table)
    for place in columns:
        justify: Literal["left", "right"] = "left" if place < table.left else "right"
        shown.add_column(Text(visible(names[place])), justify=justify, width=wide[place], overflow="fold")
    for index, row in enumerate(table.rows):
        if index in table.rules:
            shown.add_section()
        shown.add_row(*(Text(one_line(row[place])) for place in columns))
    return shown


def _headings(table: TextTable) -> list[str]:
    """Return the headings, those of numbers broken at their joints."""
    return [*table.header[: table.left], *map(_broken, table.header[table.left :])]


def _broken(name: str) -> str:
    if name.startswith("ratio to "):
        return name.replace("ratio to ", "ratio to\n").replace("?", "?\n")
    return re.sub(r"/(?=\w{3})", "/\n", name) if " " not in name else name.replace(" infer", "\ninfer")
