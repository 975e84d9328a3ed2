"""The null experiment: the same requests have the same e2e without model, seen from inside and from outside."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import same_work


@pytest.mark.slow
def test_a_black_box_hides_little_of_the_same_requests(tmp_path: Path) -> None:
    inside, outside = same_work.both(tmp_path, requests=6, warmup=1, size="64x48", max_tokens=2)
    assert inside.size == outside.size == 6
    hidden = outside - inside
    assert hidden.min() > -1e-3  # what the engine reports lies within our mark, to the nanosecond's rounding
    assert hidden.min() < inside.min()
