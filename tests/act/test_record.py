"""The plan that a record holds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from s2a_bench.act.record import observed
from tests.act.drive import call, ns, run, script, shape

SKILLS = [(1.5, call("a", 2.0)), (3.0, call("b", 1.0)), (3.5, call("c"))]


def test_a_plan_that_came_is_seen_in_seconds_from_its_request() -> None:
    record, _ = run(script([1.0, 1.5, 2.0, 3.0, 3.5], SKILLS), 2)
    plans = observed(record, shape(2))
    assert plans is not None
    assert plans.arrival_s.tolist() == [[1.5], [3.0]]
    assert plans.nominal_s.tolist() == [[2.0], [1.0]]
    assert plans.least_s.tolist() == [[1.6], [0.8]]
    assert plans.most_s.tolist() == [[3.0], [1.5]]
    assert plans.token_s is not None
    assert plans.token_s.tolist() == [[1.0], [1.5], [2.0], [3.0], [3.5]]
    assert plans.shape == shape(2)


@pytest.mark.parametrize("lack", [{"requested_ns": None}, {"token_ns": []}, {"arrivals": [(ns(1), call("a"))]}])
def test_a_plan_that_did_not_come_whole_is_not_seen(lack: dict[str, object]) -> None:
    record, _ = run(script([1.0, 1.5, 3.0], SKILLS[:2]), 2)
    assert observed(record, shape(2)) is not None
    assert observed(replace(record, **lack), shape(2)) is None  # type: ignore[arg-type]
