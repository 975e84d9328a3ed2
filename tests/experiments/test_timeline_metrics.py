"""One table of metrics: columns, schema, tables and comparison are made of it."""

from __future__ import annotations

import numpy as np
import pytest

from s2a_bench.experiments.timeline.build_rows import metrics_of
from s2a_bench.experiments.timeline.rows import METRICS, TIMELINES
from s2a_bench.policy import Plans, Schedule
from tests.made_runs import SCHEMA


def test_every_metric_has_a_column_of_its_type() -> None:
    kinds = {name: TIMELINES.columns[METRICS[name].column] for name in ("start_s", "stalls", "p_any_stall", "fluidity")}
    assert kinds == {"start_s": "int64", "stalls": "int64", "p_any_stall": "bool", "fluidity": "float64"}
    assert len({metric.column for metric in METRICS.values()}) == len(METRICS)


@pytest.mark.parametrize(
    ("name", "value", "stored"),
    [("start_s", 0.25, 250_000_000), ("stalls", 3.0, 3), ("p_any_stall", 1.0, True), ("end_regret", -1e-12, 0.0)],
)
def test_a_value_is_kept_as_its_column_holds_it(name: str, value: float, stored: float) -> None:
    assert METRICS[name].stored(value) == stored
    assert type(METRICS[name].stored(value)) is type(stored)


def test_every_metric_but_motion_is_computed() -> None:
    one = np.ones((2, 3))
    found = metrics_of(Plans(one, one, one, one), Schedule(one, one), tolerance_s=0.02)
    assert set(METRICS) - set(found) == {"rms_jerk", "peak_jerk", "sparc"}
    assert all(values.shape == (3,) for values in found.values())


def test_the_schema_has_every_metric_as_it_is() -> None:
    cell = SCHEMA["$defs"]["timeline_cell"]
    for name, metric in METRICS.items():
        assert cell["properties"][name] == {"type": "number", **metric.schema}, "run tools/schema.py"
    assert set(cell["required"]) & set(METRICS) == {name for name, each in METRICS.items() if not each.optional}
