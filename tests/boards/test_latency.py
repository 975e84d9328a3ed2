"""Latencies as people write them."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from s2a_bench.boards.gaps import Gaps, Lognormal, Markov
from s2a_bench.boards.latency import STRETCH, Ints, draw_ns, read_latency, sequence_ns
from s2a_bench.errors import UsageError

MS = 1_000_000
BURSTS = "bursty:mean_ms=10,cv=0,burst_tokens=4,within=.1"


def read(written: str) -> Gaps | Ints:
    return read_latency(written)


def drawn(written: str, count: int = 2000) -> np.ndarray:
    gaps = read(written)
    return draw_ns(gaps, np.random.default_rng(0), count)


@pytest.mark.parametrize(("written", "ns"), [("40", 40 * MS), ("0", 0), ("2.5", 2_500_000)])
def test_a_number_is_constant_milliseconds(written: str, ns: int) -> None:
    assert drawn(written, 3).tolist() == [ns] * 3


def test_a_family_has_its_mean_in_milliseconds() -> None:
    assert read("lognormal:mean_ms=80,cv=.5") == Lognormal(0.08, 0.5)
    assert drawn("lognormal:mean_ms=80,cv=0.5").mean() == pytest.approx(80 * MS, rel=0.05)
    assert drawn("bursty:mean_ms=80,cv=0.1,burst_tokens=4,within=.5").mean() == pytest.approx(80 * MS, rel=0.05)


def test_bimodal_latencies_are_pauses_that_come_alread() -> None:
    found = read("bimodal:mean_ms=80,cv=.1,pause_share=.2,pause_ratio=4")
    assert found == Markov(0.08, 0.1, 0.2, 4, 1 / 0.8)
    long = drawn("bimodal:mean_ms=80,cv=.05,pause_share=.2,pause_ratio=4", 20_000) > 100 * MS
    assert long.mean() == pytest.approx(0.2, abs=0.02)
    assert long[1:][long[:-1]].mean() == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("latency_ns\n5\n7\n", [5, 7]),
        ("request,latency_ms\n0,1.5\n1,2\n", [1_500_000, 2_000_000]),
        ("latency_s\n0.25\n", [250_000_000]),
        ("observation_ns,received_ns,d\n10,30,0\n20,25,0\n", [20, 5]),
    ],
)
def test_a_csv_file_is_played_in_its_order_and_starts_over_at_its_end(
    text: str, expected: list[int], tmp_path: Path
) -> None:
    file = tmp_path / "delays.csv"
    file.write_text(text)
    recorded = read(str(file))
    assert recorded.tolist() == expected
    assert list(islice(sequence_ns(recorded), 2 * len(expected))) == expected * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "has the columns a, b; it needs observation_ns and received_ns, or one of latency_ns"),
        ("", "has the columns none"),
        ("latency_ns\n", "has no rows"),
        ("latency_ms\n1\nsoon\n", "line 3: the latency is not a number"),
        ("latency_ms\n-1\n", "line 2: a latency of -1e+06 ns should be between 0 and an hour"),
        ("latency_ms\nnan\n", "line 2: a latency of nan ns"),
        ("observation_ns,received_ns\n5\n", "line 2: the latency is not a number"),
    ],
)
def test_a_csv_file_that_is_wrong_is_named_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text(text)
    with pytest.raises(UsageError, match=r"`latency`: .*delays.csv") as error:
        read_latency(str(file))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("-1", "`latency`: -1 should be between 0 and 3.6e+06 ms"),
        ("nan", "should be between 0"),
        ("normal:mean_ms=4", "`latency`: 'normal' is not one of the families constant, lognormal"),
        ("lognormal:cv=.5", "mean_ms should be above 0"),
        ("lognormal:mean_ms=80,cv=big", "'cv=big' should be key=number"),
        ("none.csv", "cannot read none.csv"),
    ],
)
def test_what_is_no_latency_is_one_line_that_names_it(written: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        read_latency(written)
    assert message in str(error.value)


def test_anything_else_is_left_to_others() -> None:
    assert read_latency("rtx-4080") is None
    assert read_latency("runs/a:b") is None


@pytest.mark.parametrize("written", ["80", "lognormal:mean_ms=80,cv=.5", BURSTS])
def test_the_sequence_is_the_same_each_time_whoever_asks_for_how_much(written: str) -> None:
    one, other = sequence_ns(read(written)), sequence_ns(read(written))
    assert list(islice(one, 5)) + list(islice(one, STRETCH)) == list(islice(other, STRETCH + 5))


def test_successive_values_of_a_family_that_remembers_follow_one_another() -> None:
    spans = list(islice(sequence_ns(read(BURSTS)), 40))
    first = next(place for place, span in enumerate(spans) if span > 20 * MS)
    assert [span > 20 * MS for span in spans[first : first + 12]] == [True, False, False, False] * 3
