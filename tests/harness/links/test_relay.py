"""When the relay of a link delivers each packet: in virtual time."""

from __future__ import annotations

from statistics import mean

import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.boards.links import Direction, Step
from s2a_bench.harness.links.relay import Shaper


def test_packets_queue_for_the_rate_and_then_take_the_delay() -> None:
    shaper = Shaper(Direction(12.0, delay_ms=5))  # 1,500 bytes a ms
    assert [shaper.due_s(0.0, 1500) for _ in range(3)] == pytest.approx([0.006, 0.007, 0.008])
    assert shaper.due_s(1.0, 750) == pytest.approx(1.0055)


def test_a_burst_after_idle_is_fast_and_its_credit_grows_at_the_rate() -> None:
    shaper = Shaper(Direction(12.0, burst_bytes=3000, burst_mbps=120))
    assert [shaper.due_s(0.0, 1500) for _ in range(3)] == pytest.approx([0.0001, 0.0002, 0.0012])
    assert shaper.due_s(0.0022, 1500) == pytest.approx(0.0023)  # idle for 1 ms: one packet's credit
    assert shaper.due_s(0.0023, 1500) == pytest.approx(0.0033)


@given(
    st.lists(st.tuples(st.sampled_from([0] * 20 + [30_000]), st.integers(500, 1500)), min_size=2, max_size=80),
    st.integers(1500, 9000),
)
def test_a_link_is_a_token_bucket(packets: list[tuple[int, int]], burst: int) -> None:
    """However long it was idle: between any two packets arrive no more bytes than the burst and what the rate gives."""
    way = Direction(12.0, delay_ms=3, burst_bytes=burst, burst_mbps=1e6, queue_ms=60_000)
    shaper, now_s, arrived = Shaper(way), 0.0, list[tuple[float, int]]()
    for idle_us, size in packets:
        now_s += idle_us / 1e6
        due_s = shaper.due_s(now_s, size)
        assert due_s is not None
        assert due_s - now_s >= way.least_s(size) - 1e-9
        arrived.append((due_s, size))
    for first, (start_s, _) in enumerate(arrived):
        total = 0
        for due_s, size in arrived[first:]:
            total += size
            assert total <= burst + (due_s - start_s) * 12e6 / 8 + 1500


def test_what_waits_longer_than_the_queue_is_dropped() -> None:
    shaper = Shaper(Direction(12.0, queue_ms=2))
    assert [shaper.due_s(0.0, 1500) is None for _ in range(4)] == [False, False, False, True]
    assert (shaper.dropped, shaper.lost) == (1, 0)


def test_lost_packets_take_none_of_the_rate_and_are_lost_again_with_the_same_seed() -> None:
    shapers = [Shaper(Direction(12.0, loss=0.2, seed=7, queue_ms=60_000)) for _ in range(2)]
    first, again = ([shaper.due_s(0.0, 1500) for _ in range(5000)] for shaper in shapers)
    assert first == again
    arrived = [due for due in first if due is not None]
    assert 1 - len(arrived) / 5000 == pytest.approx(0.2, abs=0.02)
    assert arrived[-1] == pytest.approx(len(arrived) * 0.001)


def test_jitter_is_added_and_packets_keep_their_order() -> None:
    shaper = Shaper(Direction(1e6, delay_ms=10, jitter_ms=4, seed=1))
    spaced = [(shaper.due_s(second, 100) or 0) - second for second in range(1000)]
    assert 0.01 <= min(spaced) < 0.0101
    assert 0.0139 < max(spaced) <= 0.01401
    assert mean(spaced) == pytest.approx(0.012, abs=0.0002)
    assert Direction(1e6, delay_ms=10, jitter_ms=4).usual_ms == 12
    dues = [shaper.due_s(2000 + number / 1e4, 100) or 0 for number in range(1000)]
    assert dues == sorted(dues)


def test_a_trace_repeats_waits_out_its_outages_and_has_its_own_delay_and_loss() -> None:
    steps = (
        Step(0.0, 12.0, 0.0, 0.0),
        Step(0.002, 0.0, 0.0, 0.0),
        Step(0.003, 24.0, 1.0, 0.0),
        Step(0.009, 12, 0, 1.0),
    )
    shaper = Shaper(Direction(24.0, steps=steps, period_s=0.01))
    assert [shaper.due_s(0.0, 1500) for _ in range(3)] == pytest.approx([0.001, 0.002, 0.0035], abs=1e-6)
    assert shaper.due_s(0.0135, 1500) == pytest.approx(0.015, abs=1e-6)
    assert shaper.due_s(0.0195, 1500) is None
