"""A run whose server is on another host: what begins on one clock and ends on the other has two ends, everywhere."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.experiments.latency.metrics import latency_csv, latency_json
from s2a_bench.experiments.latency.view import latency_figures, show
from s2a_bench.experiments.requests import cells_of
from s2a_bench.report.compare.comparison import metrics_of, open_comparison
from s2a_bench.store.run import StoredRun
from tests.experiments.view.test_latency_json import validate

STAGES = {"capture": 1, "cdr_pack": 2, "network": 3, "accept": 1, "inference": 100, "return": 0.25}


@pytest.fixture
def run(make_run: Callable[..., StoredRun]) -> StoredRun:
    fields = {"clock_error_ns": 500_000, "frame_age_lo_ns": 5_000_000, "frame_age_hi_ns": 6_000_000}
    return make_run({"ros/action": STAGES}, n=4, spread=0, n_tokens=2, **fields)


def test_json_has_both_ends_and_no_point_between_them(run: StoredRun) -> None:
    whole = json.loads(json.dumps(latency_json(cells_of(run)), allow_nan=False))
    validate(whole)
    (cell,) = whole["cells"]

    def medians(summary: dict[str, dict[str, float]]) -> tuple[float, float]:
        assert set(summary) == {"lo", "hi"}
        return summary["lo"]["median"], summary["hi"]["median"]

    assert medians(cell["stages_ms"]["network"]) == (2.5, 3.5)
    assert medians(cell["stages_ms"]["return"]) == (0, 0.75)  # no time is negative
    assert medians(cell["groups_ms"]["network"]) == (3.5, 4.5)  # with `accept`, which is exact
    assert medians(cell["frame_age_ms"]) == (5, 6)
    exact = [cell["stages_ms"]["accept"], cell["round_trip_ms"], cell["e2e_ms"], cell["e2e_without_inference_ms"]]
    assert [each["median"] for each in exact] == [1, 3.25, 107.25, 7.25]


def test_csv_and_tables_have_both_ends(run: StoredRun) -> None:
    rows = {row[2]: row[4] for row in latency_csv(cells_of(run))["stages.csv"].rows}
    assert (rows["network_lo"], rows["network_hi"]) == (2.5, 3.5)
    assert "network" not in rows
    summary = {row[1]: row[5] for row in latency_csv(cells_of(run))["summary.csv"].rows}
    assert (summary["frame_age_lo_ms"], summary["frame_age_hi_ms"]) == (5, 6)
    table = show(run).tables["stages"]
    entries = {row[1]: row[2] for row in table.rows}
    assert (entries["network"], entries["return"]) == ("[2.50, 3.50]", "[0.000, 0.750]")
    assert entries["round trip"].startswith("3.25 ")
    assert any("known to ± 0.500 ms" in note for note in table.notes)


def test_the_figure_shows_where_the_ends_may_lie(run: StoredRun) -> None:
    axes = latency_figures(cells_of(run))["stages"]().axes[0]
    lines = [line.get_xdata().tolist() for line in axes.get_lines() if len(set(line.get_ydata())) == 1]  # type: ignore[union-attr]
    assert [6.5, 7.5] in lines  # capture 1, pack 2, network 4 in the middle of 3.5 to 4.5
    assert len(lines) == 2


def test_compare_has_the_round_trip_and_no_one_way_time(run: StoredRun) -> None:
    compared = open_comparison([run], [run], unlike=False, least=0.05)
    assert [metric.name for metric, _ in metrics_of(compared, ["round_trip"])] == ["round_trip"]
    for name in ("network", "return", "group.network", "frame_age", "token_delay"):
        with pytest.raises(UsageError, match="no cell has"):
            metrics_of(compared, [name])
