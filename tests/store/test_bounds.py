"""What rows declare of their numbers is JSON Schema, also where a number may be absent."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from s2a_bench.store.bounds import Count, Fraction, Many, NonNegative, Positive, about


@pytest.mark.parametrize(
    ("bound", "kind", "says"),
    [
        (Count, int, {"minimum": 0}),
        (Many, int, {"minimum": 1}),
        (NonNegative, float, {"minimum": 0}),
        (Positive, float, {"exclusiveMinimum": 0}),
        (Fraction, float, {"minimum": 0, "maximum": 1}),
    ],
)
def test_a_bound_is_json_schema_s(bound: Any, kind: type, says: dict[str, int]) -> None:
    assert get_args(bound) == (kind, says)
    assert get_args(bound | None) == (bound, type(None))


def test_a_description_is_for_people() -> None:
    assert about("in s") == {"description": "in s"}
