import math

import pytest

from s2a_bench.stats import Summary, summarise


def test_a_summary_by_hand() -> None:
    # 1..5: mean 3, squares of the distances 4+1+0+1+4 = 10, sd = sqrt(10/4);
    # rank of p90 = .9 * 4 = 3.6 -> 4.6; of p99 = .99 * 4 = 3.96 -> 4.96
    summary = summarise([5, 1, 4, 2, 3])
    assert (summary.n, summary.mean, summary.median) == (5, 3.0, 3.0)
    assert summary.sd == pytest.approx(math.sqrt(2.5))
    assert summary.p90 == pytest.approx(4.6)
    assert summary.p99 == pytest.approx(4.96)


def test_a_single_value_has_no_spread() -> None:
    assert summarise([7.0]) == Summary(1, 7.0, 7.0, None, 7.0, 7.0)


def test_no_values_have_no_summary() -> None:
    with pytest.raises(ValueError, match="at least one value"):
        summarise([])
