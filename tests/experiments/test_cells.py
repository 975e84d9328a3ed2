"""Rows whose annotations are metrics: what follows from them, for all rows of a run and for each cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import pandas as pd
import pytest

from s2a_bench.experiments.cells import (
    ANY,
    HIDDEN,
    SHARE,
    Cells,
    JsonKey,
    Metric,
    columns_of,
    json_of,
    metrics_of,
    share,
)
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.schema import NonNegative


@dataclass(frozen=True, kw_only=True)
class Lap:
    """A row of every kind of column."""

    cell: str
    board: Annotated[str, JsonKey("profile")] = ""
    draw: Annotated[int, HIDDEN] = 0
    prompt_s: NonNegative | None = None
    start_ns: Annotated[int, Metric("start", "Its start.")]
    turns: Annotated[int, Metric(better="higher")] = 3
    stalled: Annotated[bool, Metric()] = False
    late: Annotated[float | None, share("late, %", "Of the lap.")] = None
    drift: Annotated[float | None, Metric("drift", unit="m", bounds=ANY)] = None


class StoredLap(Lap):
    """The same in ``--json`` as in the columns."""

    as_stored: ClassVar = True


def cells(*laps: Lap) -> Cells[Lap]:
    return Cells(pd.DataFrame([vars(lap) for lap in laps]), Lap, Origins(Provenance()))


def test_a_metric_has_its_name_unit_and_kind_from_its_column() -> None:
    metrics = metrics_of(Lap)
    assert {name: (each.column, each.unit, each.kind) for name, each in metrics.items()} == {
        "start_s": ("start_ns", "s", "time"),
        "turns": ("turns", "", "count"),
        "p_stalled": ("stalled", "", "flag"),
        "late": ("late", "", SHARE),
        "drift": ("drift", "m", "number"),
    }
    assert (metrics["late"].statistic, metrics["late"].bounds) == ("mean", (0, 1))


def test_json_has_times_in_seconds_and_no_key_for_what_is_missing_or_hidden() -> None:
    lap = {"cell": "a", "start_ns": 1_500_000_000}
    assert json_of(Lap(**lap)) == {"cell": "a", "profile": None, "start_s": 1.5, "turns": 3, "p_stalled": False}
    assert json_of(Lap(**lap, board="x", drift=-1.0))["profile"] == "x"
    assert json_of(StoredLap(**lap))["start_ns"] == lap["start_ns"]
    assert [column.name for column in columns_of(StoredLap)] == [column.name for column in columns_of(Lap)]


def test_cells_are_split_in_their_order_and_have_values_without_missing_ones() -> None:
    laps = cells(
        *(Lap(cell=name, start_ns=ns, drift=drift) for name, ns, drift in [("b", 2 * 10**9, 1.0), ("a", 10**9, None)])
    )
    assert list(laps.split()) == ["b", "a"]
    assert laps.values("start_s").tolist() == [2.0, 1.0]
    assert laps.where(cell="a").values("drift").size == 0
    assert laps.where(cell="a").mean("drift") is None
    assert laps.where(cell="a").rows == [Lap(cell="a", start_ns=1_000_000_000)]
    b, a = laps.json()
    assert (b["n"], b["start_s"]["median"], b["drift"]["n"], "drift" in a) == (1, 2.0, 1, False)


def test_a_table_has_each_cell_and_what_is_compared_its_setting() -> None:
    laps = cells(*(Lap(cell="a", board="x", start_ns=place * 10**9) for place in range(4)))
    table = laps.table("laps", ["start_s", "drift"])
    assert table.header == ("cell", "n", "start (s), median", "drift (m), median")
    assert table.rows == [("a", "4", "1.50", "\N{EN DASH}")]
    (subject,) = laps.subjects(["board"])
    assert (subject.name, subject.setting, subject.n, len(subject.rows("start_s"))) == ("a", {"board": "x"}, 4, 4)
    assert not subject.rows("unknown")
    with pytest.raises(KeyError):
        laps.values("unknown")
