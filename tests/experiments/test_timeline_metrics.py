"""One table of metrics: columns, schema, tables and comparison are made of it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from s2a_bench.experiments.timeline.build_rows import share, timeline_rows
from s2a_bench.experiments.timeline.rows import METRICS, TIMELINES, TimelineRow
from s2a_bench.harness.timelines.cases import PlanSetting
from s2a_bench.policy import Plans, Schedule
from tests.made_runs import SCHEMA


def test_every_metric_has_a_column_of_its_type() -> None:
    kinds = {name: TIMELINES.columns[METRICS[name].column] for name in ("start_s", "stalls", "p_any_stall", "fluidity")}
    assert kinds == {"start_s": "int64", "stalls": "int64", "p_any_stall": "bool", "fluidity": "float64"}
    assert len({metric.column for metric in METRICS.values()}) == len(METRICS)


@pytest.fixture
def row() -> TimelineRow:
    """Make one plan of two skills of 1 s that arrive at 0.25 and 1.5 s, and start as they arrive."""
    arrival_s, nominal_s = np.array([[0.25], [1.5]]), np.ones((2, 1))
    plans = Plans(arrival_s, nominal_s, nominal_s, nominal_s)
    setting = PlanSetting("", "a rate", 4.0, 0.5, 1, 2, 1.0)
    (made,) = timeline_rows(setting, "naive", plans, Schedule(arrival_s, nominal_s), ["a"])
    return made


@pytest.mark.parametrize(
    ("column", "stored"),
    [
        ("start_ns", 250_000_000),
        ("stalls", 1),
        ("any_stall", True),
        ("stall_ns", 250_000_000),
        ("stall_ratio", round(0.25 / 2.25, 9)),
        ("start_regret", 0.0),
        ("signed_start_regret", -0.5),
    ],
)
def test_a_value_is_kept_as_its_column_holds_it(row: TimelineRow, column: str, stored: float) -> None:
    assert getattr(row, column) == stored
    assert type(getattr(row, column)) is type(stored)


def test_a_rounding_error_is_no_share() -> None:
    assert str(share(-1e-12)) == "0.0"


def test_every_metric_is_computed(row: TimelineRow) -> None:
    assert None not in [getattr(row, metric.column) for metric in METRICS.values()]


def test_the_schema_has_every_metric_as_it_is() -> None:
    cell = SCHEMA["$defs"]["timeline_cell"]
    for name, metric in METRICS.items():
        least, most = metric.bounds
        facts = {"description": metric.about or None, "type": "number", "minimum": least, "maximum": most}
        there = {key: value for key, value in facts.items() if value is not None}
        assert cell["properties"][name] == there, "run tools/schema.py"
    may_lack = {item.name for item in fields(TimelineRow) if item.default is None}
    assert set(cell["required"]) & set(METRICS) == {
        name for name, each in METRICS.items() if each.column not in may_lack
    }
