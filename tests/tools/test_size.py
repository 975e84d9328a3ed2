"""How lines are counted."""

from __future__ import annotations

from tools.size import BUDGETS, Size, excess, size_of

TEXT = '''"""A docstring
of two lines."""

# a comment
TEXT = """two
lines"""


def double(x: int) -> int:
    """Return twice x."""
    return (  # a reason
        2 * x
    )
'''


def test_lines_of_code_are_neither_docstrings_nor_comments_nor_blank() -> None:
    size = size_of(TEXT)
    assert (size.lines, size.code, size.files) == (13, 6, 1)


def test_more_lines_than_a_budget_are_named_and_plug_ins_are_no_part_of_the_core() -> None:
    most = BUDGETS["core"]
    found = {"ros": Size(most), "plugins/carla": Size(BUDGETS["s2a_bench"] - most), "tests": Size(BUDGETS["tests"])}
    assert excess(found) == []
    found["ros"].add(Size(2))
    found["tests"].add(Size(1))
    assert [line.split(" lines")[0] for line in excess(found)] == ["s2a_bench has 2", "core has 2", "tests has 1"]
