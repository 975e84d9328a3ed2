"""The requests of a run as arrays, against the same made row by row."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from s2a_bench.experiments.columns import RequestColumns
from s2a_bench.experiments.requests import cells_of
from s2a_bench.store.requests import TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from tests.made_runs import known, row_of

STAGES = {"capture": 1, "network": 2, "inference": 3, "return": 1}
NAMES = ("r10", "r9", "r2", "lost")
FACTS: tuple[dict[str, float], ...] = ({"prompt_ms": 0.1 + 0.2, "predicted_n": 3}, {}, {"predicted_n": 1e-7}, {})
GAPS_NS = ((5, 7), (11,), (13, 17, 19), (23,))


@pytest.fixture(params=["in order", "by turns", "backwards"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> StoredRun:
    """Make a run whose tokens are stored in an order."""
    tokens = []
    with RunWriter.create(tmp_path, "latency", known({})) as writer:
        for block, (name, facts, gaps) in enumerate(zip(NAMES, FACTS, GAPS_NS, strict=True)):
            row = replace(row_of("ros/topic", STAGES, block, facts=facts, launch=block % 2), request_id=name)
            writer.sample(replace(row, error="lost" if name == "lost" else ""))
            at_ns = np.cumsum((10**18 + 1, *gaps)).tolist()
            tokens += [TokenRow(name, row.cell, i, i, "x", at - 3 if i else None, at) for i, at in enumerate(at_ns)]
        orders = {"in order": tokens, "by turns": sorted(tokens, key=lambda row: row.index), "backwards": tokens[::-1]}
        writer.tokens(orders[str(request.param)])
    return read_run(writer.path)


def test_tokens_are_put_in_order_and_none_is_between_two_requests(run: StoredRun) -> None:
    answers = RequestColumns(run).answers
    assert answers.counts.tolist() == [3, 2, 4, 2]
    assert answers.spans_ns.tolist() == [12, 11, 49, 23]
    for request, gaps in enumerate(GAPS_NS):
        mine = answers.tokens_of(np.array([request]))
        assert answers.index()[mine].tolist() == list(range(len(gaps) + 1))
        first, *others = answers.times_ns("gap")[mine].tolist()
        assert (np.isnan(first), tuple(others)) == (True, gaps)
        assert answers.times_ns("delay")[mine][1:].tolist() == [3.0] * len(gaps)


def test_rows_of_tokens_are_in_time_order_and_values_by_id(run: StoredRun) -> None:
    (cell,) = cells_of(run)
    rows = cell.rows("itl")
    assert (rows.values * 1e6).round().tolist() == [5, 7, 11, 13, 17, 19]
    assert rows.sizes is not None
    assert rows.sizes.tolist() == [2, 1, 3]
    assert (cell.values("itl") * 1e6).round().tolist() == [5, 7, 13, 17, 19, 11]  # r10, r2, r9
    assert [cells[0].rows("itl").sizes.tolist() for cells in cells_of(run).launches().values()] == [[2, 3], [1]]  # type: ignore[union-attr]  # they are tokens


def test_facts_are_those_that_a_json_parser_reads(run: StoredRun) -> None:
    read = [json.loads(facts) for facts in run.samples["facts"]]
    for name in ("prompt_ms", "predicted_n", "energy_j", "unheard_of"):
        expected = [facts.get(name, float("nan")) for facts in read]
        assert np.array_equal(RequestColumns(run).fact(name), expected, equal_nan=True)


def test_a_column_that_a_run_lacks_is_missing_everywhere(run: StoredRun) -> None:
    columns = RequestColumns(run)
    assert np.isnan(columns.numbers("connect")).all()
    assert columns.numbers("network_ms")[:3].tolist() == columns.numbers("network")[:3].tolist() == [2.0] * 3
    assert columns.numbers("network_ns")[0] == 2e6
    assert np.isnan(columns.numbers("network")[-1])  # it failed
