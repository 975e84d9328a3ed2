"""What a table makes of a row."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import RunWriter, read_run
from s2a_bench.store.schema import Table


@dataclass(frozen=True)
class Row:
    """A row with a field of every kind."""

    whole: int | None = None
    real: float | None = None
    yes: bool = False
    text: str = ""
    items: list[object] = field(default_factory=list)
    provenance: str = ""


@dataclass(frozen=True)
class LongerRow(Row):
    """The same, of a later version."""

    later: int | None = None


@dataclass(frozen=True)
class CellRow:
    """A row of a cell."""

    cell: str
    provenance: str = ""


ROWS = Table("rows", Row, {"twice": "int64", "none": "float64"}, lambda row: {"twice": 2 * (row.whole or 0)})


def test_a_table_has_the_fields_then_what_is_derived_then_the_provenance() -> None:
    assert list(ROWS.columns.items()) == [
        *(("whole", "int64"), ("real", "float64"), ("yes", "bool"), ("text", "string"), ("items", "json")),
        *(("twice", "int64"), ("none", "float64"), ("provenance", "string")),
    ]
    assert list(ROWS.values(Row(3, 0.5, True, "x", [1, {"a": 2.5}]), "real")) == [
        *(3, 0.5, True, "x", '[1,{"a":2.5}]', 6, None, "real"),
    ]


@pytest.mark.parametrize("least", [-(2**63), 0])
def test_a_whole_number_beyond_64_bits_is_null(least: int) -> None:
    values = [least - 1 if least else 2**63, least, 2**63 - 1]
    assert [next(ROWS.values(Row(value))) for value in values] == [None, *values[1:]]
    assert list(ROWS.values(Row(items=[*values])))[4] == f"[null,{least},{2**63 - 1}]"


def test_columns_that_an_older_run_does_not_have_are_null(tmp_path: Path) -> None:
    later = Table("rows", LongerRow)
    with RunWriter.create(tmp_path, "latency", {}) as run:
        run.append(Table("rows", Row), [Row(whole=1), Row(whole=2)])
        running = read_run(run.path).table(later)
    done = read_run(run.path).table(later)
    assert list(done.columns) == list(later.columns)
    assert done.equals(running)
    assert done["whole"].tolist() == [1, 2]
    assert done["later"].isna().tolist() == [True, True]


def test_a_row_says_itself_where_it_comes_from_else_its_cell_or_the_run(tmp_path: Path) -> None:
    values = Origins(Provenance(), {name: Provenance(name, link="real") for name in ("echo", "llama")}).to_manifest()
    cells = Table("cells", CellRow)
    with RunWriter.create(tmp_path, "latency", {"provenance": values}) as run:
        run.append(cells, [CellRow("echo"), CellRow("llama"), CellRow("echo", "its own")])
    found = read_run(run.path).table(cells)["provenance"].tolist()
    assert found == ["echo/unknown/unknown", "llama/unknown/unknown", "its own"]
