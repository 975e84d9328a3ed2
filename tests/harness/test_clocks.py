"""Offsets between clocks: simulated exchanges, whose true offset is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from statistics import mean

import pytest

from s2a_bench.errors import ClockMoved
from s2a_bench.harness.clocks import WINDOW_NS, Exchange, Interval, Offset

SECOND_NS, MS_NS = 10**9, 10**6
UP_NS, DOWN_NS = 10 * MS_NS, MS_NS
"""Least delays of the simulated link, 10:1."""
SEEDS = range(200)


@dataclass(frozen=True)
class Simulated:
    """Exchanges, five a second, over an asymmetric link with queues; the other clock is ``offset`` ahead."""

    exchanges: list[Exchange]
    offset: Callable[[int], float]
    least_ns: float
    """Least delay up and least delay down together."""

    @staticmethod
    def of(
        seed: int, moved: Callable[[float], float] = lambda _: 0.0, seconds: int = 60, longer: float = 1.0
    ) -> Simulated:
        """Simulate a drift of up to 50 ppm and an offset of 5 s; ``moved`` is added to the other clock."""
        random = Random(seed)
        start_ns, rate = random.choice((-5, 5)) * SECOND_NS, random.uniform(-50e-6, 50e-6)

        def offset(at_ns: float) -> float:
            return start_ns + rate * at_ns + moved(at_ns)

        made, ups, downs = [], [], []
        for number in range(5 * seconds):
            sent = round((number + random.random() / 2) * SECOND_NS / 5)
            up, down = (longer * least * (1 + random.expovariate(1.0)) for least in (UP_NS, DOWN_NS))
            came, answered = sent + up, sent + up + random.uniform(0, MS_NS)
            seen = answered + down
            made.append(Exchange(sent, round(came + offset(came)), round(answered + offset(answered)), round(seen)))
            ups.append(up)
            downs.append(down)
        return Simulated(made, offset, min(ups) + min(downs))

    def interval(self, *times_ns: int) -> Interval:
        offset = Offset()
        for each in self.exchanges:
            offset.add(each)
        return offset.over(*times_ns)


@pytest.fixture(scope="module")
def simulations() -> list[Simulated]:
    return [Simulated.of(seed) for seed in SEEDS]


@pytest.mark.parametrize(("place", "widest"), [(150, 1.1), (0, 1.5), (-1, 1.5)], ids=["middle", "first", "last"])
def test_every_interval_holds_the_offset_and_is_narrow(simulations: list[Simulated], place: int, widest: float) -> None:
    for simulated in simulations:
        each = simulated.exchanges[place]
        at_ns = each.seen_ns if place else each.sent_ns
        found = simulated.interval(at_ns)
        assert found.lo_ns <= simulated.offset(at_ns) <= found.hi_ns
        assert found.hi_ns - found.lo_ns <= widest * simulated.least_ns


def test_points_of_usual_methods_miss_the_offset(simulations: list[Simulated]) -> None:
    """A midpoint is off by half the asymmetry, and a mean by the queues as well; docs/two-hosts.md has the table."""
    for simulated in simulations:
        exchanges = simulated.exchanges[:10]
        middles = [(each.upper[1] + each.lower[1]) / 2 for each in exchanges]
        shortest = min(exchanges, key=lambda each: each.upper[1] - each.lower[1])
        truth = simulated.offset(exchanges[5].sent_ns)
        inside = simulated.interval(exchanges[5].sent_ns)
        for point in (mean(middles), middles[exchanges.index(shortest)]):
            assert abs(point - truth) > 3 * MS_NS
            assert point - truth > (UP_NS - DOWN_NS) / 3  # late by about half the asymmetry, in every seed
        assert inside.lo_ns <= truth <= inside.hi_ns


def test_an_interval_over_a_request_holds_every_offset_in_it(simulations: list[Simulated]) -> None:
    for simulated in simulations[:20]:
        first, last = simulated.exchanges[100].sent_ns, simulated.exchanges[180].seen_ns
        found = simulated.interval(first, last)
        assert all(found.lo_ns <= simulated.offset(at) <= found.hi_ns for at in range(first, last, SECOND_NS))


def step(at_ns: float) -> float:
    return 30 * MS_NS * (at_ns > 30 * SECOND_NS)


def slew(at_ns: float) -> float:
    """Move at 500 ppm from the middle on, as fast as NTP slews."""
    return 500e-6 * max(0.0, at_ns - 30 * SECOND_NS)


@pytest.mark.parametrize("moved", [step, slew])
def test_a_clock_that_is_stepped_or_slewed_is_an_error(moved: Callable[[float], float]) -> None:
    for seed in SEEDS:
        simulated = Simulated.of(seed, moved, longer=0.1)
        with pytest.raises(ClockMoved, match=r"by about [\d.]+ ms within 60 s: one was stepped or slewed"):
            simulated.interval(simulated.exchanges[150].sent_ns)


def test_a_step_more_than_a_window_ago_no_longer_counts() -> None:
    simulated = Simulated.of(0, lambda at_ns: 30 * MS_NS * (at_ns > SECOND_NS), seconds=100)
    at_ns = simulated.exchanges[-1].seen_ns
    assert at_ns - WINDOW_NS > SECOND_NS
    found = simulated.interval(at_ns)
    assert found.lo_ns <= simulated.offset(at_ns) <= found.hi_ns


def test_one_exchange_bounds_its_own_one_way_times() -> None:
    only = Exchange(sent_ns=100, received_ns=5_000_150, answered_ns=5_000_250, seen_ns=300)
    offset = Offset()
    offset.add(only)
    found = offset.over(only.sent_ns, only.seen_ns)
    assert found.lo_ns <= 5_000_000 <= found.hi_ns
    assert found.half_ns >= found.middle_ns - found.lo_ns
