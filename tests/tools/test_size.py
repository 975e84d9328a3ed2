"""How lines are counted."""

from __future__ import annotations

from pathlib import Path

from tools.size import BUDGETS, Size, excess, room_of, size_of

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


def test_rooms_are_folders_and_each_transport_experiment_and_report_is_one() -> None:
    rooms = {
        "s2a_bench/clock.py": "(top)",
        "s2a_bench/ros/dds.py": "ros",
        "s2a_bench/machine/doctor/gpu.py": "machine",
        "s2a_bench/transport/serving.py": "transport",
        "s2a_bench/transport/http/dialects/ollama.py": "transport/http",
        "s2a_bench/experiments/ccrb/view/tables.py": "experiments/ccrb",
        "s2a_bench/plugins/carla/world.py": "plugins/carla",
        "tools/size.py": "tools",
    }
    assert {path: room_of(Path(path)) for path in rooms} == rooms


def test_more_lines_than_a_budget_are_named_and_plug_ins_are_no_part_of_the_core() -> None:
    most = BUDGETS["core"]
    found = {"ros": Size(most), "plugins/carla": Size(BUDGETS["s2a_bench"] - most), "tests": Size(10**6)}
    assert excess(found) == []
    found["ros"].add(Size(2))
    assert [line.split(" lines")[0] for line in excess(found)] == ["s2a_bench has 2", "core has 2"]
