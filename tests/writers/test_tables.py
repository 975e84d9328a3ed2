"""Tables on a terminal: whole at any width."""

from __future__ import annotations

import io

from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from s2a_bench.writers.tables import TextTable, fits, lay_out


def printed(table: TextTable, width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(lay_out(table, width))
    assert isinstance(console.file, io.StringIO)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


WIDE = TextTable(
    "Times",
    ("board", "L", "policy", "start", "stalled", "late start", "ratio to ros/topic"),
    [
        ("Orin", "6", "naive", "13.34", "65.41", "8.9%", "3.05 [1.38, 6.72]"),
        ("", "", "wait", "85.76", "0.00", "0%", "1"),
    ],
    3,
)


def test_columns_without_room_follow_in_a_block_of_their_own() -> None:
    assert printed(WIDE, 50) == [
        "Times",
        "                                   late",
        "board  L  policy  start  stalled  start",
        "───────────────────────────────────────",
        "Orin   6  naive   13.34    65.41   8.9%",
        "          wait    85.76     0.00     0%",
        "",
        "                           ratio to",
        "board  L  policy          ros/topic",
        "───────────────────────────────────",
        "Orin   6  naive   3.05 [1.38, 6.72]",
        "          wait                    1",
        "",
    ]


@settings(max_examples=50)
@given(
    st.integers(50, 140),
    st.integers(1, 3),
    st.integers(1, 12),
    st.integers(1, 3),
    st.lists(st.text("abc/?=-", min_size=1, max_size=60), min_size=3, max_size=3),
    st.sampled_from(["1", "12.34", "3.05 [1.38, 6.72]"]),
)
def test_no_number_is_lost_at_any_width(
    width: int, left: int, columns: int, rows: int, names: list[str], number: str
) -> None:
    header = tuple(f"column {place}" for place in range(left + columns))
    body = [(*names[:left], *(f"{number}{row}{place}" for place in range(columns))) for row in range(rows)]
    table = TextTable("Numbers", header, body, left)
    text = printed(table, width)
    assert max(map(len, text)) <= width
    joined = "\n".join(text)
    assert all(cell in joined for row in body for cell in row[left:])
    assert "".join(names[:left]).count("a") <= joined.count("a")
    assert not fits(table, width) or joined.count("column 0") == 1
