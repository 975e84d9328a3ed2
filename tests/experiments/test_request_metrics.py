"""A metric of requests is one row of a table: JSON, its schema, CSV, comparison and the table of tokens follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.experiments import requests
from s2a_bench.experiments.latency import metrics, view
from s2a_bench.experiments.requests import RequestMetric
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from tests.made_runs import STAGES, known

LATE = RequestMetric(
    "token_late",
    "ms",
    title="late",
    about="From a token's leaving the engine to the client's seeing it, twice.",
    of=lambda cell: 2 * (cell.answers["client_ns"] - cell.answers["engine_ns"]) / 1e6,
    shown=("median",),
)


@pytest.fixture
def run(tmp_path: Path, make_row: Callable[..., SampleRow]) -> StoredRun:
    with RunWriter.create(tmp_path, "latency", known({"stages": STAGES})) as writer:
        for block in range(2):
            row = make_row("ros/topic", {"capture": 1, "inference": 100, "return": 0.5}, block)
            writer.sample(row)
            writer.tokens(
                TokenRow(row.request_id, row.cell, i, i, "x", 10**9 + i, 10**9 + i + (block + 1) * 10**6)
                for i in range(3)
            )
    return read_run(writer.path)


def with_late(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a copy of the module of latency's metrics, made where `LATE` is a metric of tokens."""
    monkeypatch.setattr(requests, "TOKEN_METRICS", (*requests.TOKEN_METRICS, LATE))
    spec = find_spec("s2a_bench.experiments.latency.metrics")
    assert spec is not None
    assert spec.loader is not None
    made = module_from_spec(spec)
    spec.loader.exec_module(made)
    monkeypatch.setattr(view, "METRICS", made.METRICS)
    return made


def test_a_metric_is_added_in_one_place_and_is_nowhere_without_it(
    run: StoredRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "token_late" not in metrics.COMPARED.metrics
    assert "token_late_ms" not in metrics.latency_json(run)["cells"][0]
    assert "late median" not in view.latency_tables(run)["tokens"]().header
    made = with_late(monkeypatch)
    (subject,) = made.COMPARED.subjects(run)
    assert [row.tolist() for row in subject.rows("token_late")] == [[2.0] * 3, [4.0] * 3]
    assert made.COMPARED.metrics["token_late"] is LATE
    (cell,) = made.latency_json(run)["cells"]
    assert (cell["token_late_ms"]["n"], cell["token_late_ms"]["median"]) == (6, 3.0)
    assert "token_late_ms" in {field.name for field in fields(made.LatencyCell)}
    rows = {str(row[1]): row for row in made.latency_csv(run)["summary.csv"].rows}
    assert rows["token_late_ms"][4:6] == (6, 3.0)
    table = view.latency_tables(run)["tokens"]()
    assert (table.header[-1], table.rows[0][-1]) == ("late median", "3.00")
