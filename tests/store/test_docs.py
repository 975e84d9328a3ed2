"""docs/results.md knows every table that a run folder may hold."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import s2a_bench
from s2a_bench.store.requests import frames_table, samples_table
from s2a_bench.store.schema import Table

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "results.md").read_text("utf-8")
LISTED = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", PAGE.split("## Every table")[1].split("\n## ")[0], re.MULTILINE))
"""Table -> what the page says of it."""
DECLARING = [
    ".".join(path.relative_to(Path(s2a_bench.__file__).parents[1]).with_suffix("").parts)
    for path in Path(s2a_bench.__file__).parent.rglob("*.py")
    if re.search(r": Final\[Table\[", path.read_text("utf-8"))
]
FIXED = {found.name for name in DECLARING for found in vars(import_module(name)).values() if isinstance(found, Table)}
TABLES = sorted({*FIXED, samples_table({}).name, frames_table({}).name})


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_listed_with_the_place_where_its_columns_are(name: str) -> None:
    assert name in LISTED, f"docs/results.md, 'Every table', does not name {name}"
    links = re.findall(r"\]\(([\w./-]*)(?:#([\w-]+))?\)", LISTED[name])
    assert links, f"docs/results.md does not say where the columns of {name} are"
    for page, heading in links:
        text = (DOCS / page).read_text("utf-8") if page else PAGE
        if heading:
            headings = [
                re.sub(r"[^\w -]", "", line).strip().lower() for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)
            ]
            assert heading in [line.replace(" ", "-") for line in headings]


def test_no_table_is_listed_that_there_is_not() -> None:
    assert set(LISTED) == set(TABLES)
