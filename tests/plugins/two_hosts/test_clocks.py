"""Offsets between clocks: simulated exchanges, whose true offset is known, and what chrony and PTP say of an error."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from itertools import pairwise
from random import Random
from statistics import mean
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from s2a_bench.clock import VirtualClock, clock_id
from s2a_bench.errors import ClockMoved, RequestFailed, UsageError
from s2a_bench.machine.clocks import REALTIME_ERROR_MS, REALTIME_MS, WALL_CLOCKS, WallClock
from s2a_bench.plugins.two_hosts import clocks
from s2a_bench.plugins.two_hosts.clocks import (
    KEPT,
    RATE,
    WINDOW_NS,
    Exchange,
    Interval,
    Offset,
    RemoteClock,
    interval_at,
)
from s2a_bench.plugins.two_hosts.surroundings import HostOptions
from s2a_bench.trace import Remote, Trace
from tests.conftest import examples

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
    for simulated in simulations[:20]:
        exchanges = simulated.exchanges[:10]
        middles = [(each.upper[1] + each.lower[1]) / 2 for each in exchanges]
        shortest = min(exchanges, key=lambda each: each.upper[1] - each.lower[1])
        truth = simulated.offset(exchanges[5].sent_ns)
        inside = simulated.interval(exchanges[5].sent_ns)
        for point in (mean(middles), middles[exchanges.index(shortest)]):
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
        with pytest.raises(ClockMoved, match=r"by about [\d.]+ ms within 60 s: one was stepped or slewed") as error:
            simulated.interval(simulated.exchanges[150].sent_ns)
        said_ms = float(re.findall(r"about ([\d.]+) ms", str(error.value))[0])
        assert 25 < said_ms < 33 or moved is slew


def test_a_step_more_than_a_window_ago_no_longer_counts() -> None:
    simulated = Simulated.of(0, lambda at_ns: 30 * MS_NS * (at_ns > SECOND_NS), seconds=100)
    at_ns = simulated.exchanges[-1].seen_ns
    assert at_ns - WINDOW_NS > SECOND_NS
    found = simulated.interval(at_ns)
    assert found.lo_ns <= simulated.offset(at_ns) <= found.hi_ns


def best(at_ns: int, exchanges: Sequence[Exchange], slack_ns: float) -> tuple[float, float] | None:
    """Return the least and the greatest a + b t over all lines between the bounds, by linear programming."""
    rows = [((1, (time - at_ns) / 1e6), bound + slack_ns) for time, bound in (each.upper for each in exchanges)]
    rows += [((-1, (at_ns - time) / 1e6), slack_ns - bound) for time, bound in (each.lower for each in exchanges)]
    within = {"A_ub": [row for row, _ in rows], "b_ub": [most for _, most in rows]}
    limits = [(None, None), (-RATE * 1e6, RATE * 1e6)]
    low, high = (linprog((sign, 0), **within, bounds=limits, method="highs") for sign in (1, -1))
    return (low.fun, -high.fun) if low.success else None


ONE = st.builds(
    lambda sent, wide, offset, up, bounded: (
        Exchange.bounded((sent + wide) * 1000, offset, up)
        if bounded
        else Exchange(sent * 1000, sent * 1000 + offset + up, sent * 1000 + offset + up, (sent + wide) * 1000)
    ),
    st.integers(-5000, 5000),
    st.integers(1, 400),
    st.integers(-40_000, 40_000),
    st.integers(0, 400_000),
    st.booleans(),
)


@settings(max_examples=examples(200))
@given(st.lists(ONE, min_size=1, max_size=7), st.integers(-9000, 9000))
@example([Exchange(0, 100, 100, 200), Exchange(1000, 1250, 1250, 1200)], 0)
@example([Exchange(0, 100, 100, 200), Exchange(1000, 950, 950, 1200)], 0)
@example([Exchange(-1000, 9000, 9000, -900), Exchange(0, 10_000 - 300, 9800, 100)], 500)
def test_an_interval_is_that_of_every_line_between_the_bounds(exchanges: list[Exchange], at_us: int) -> None:
    """At most what floats lose is added; without such a line it is an error."""
    inner, outer = (best(at_us * 1000, exchanges, slack_ns) for slack_ns in (0, 0.5 + 1e-3))
    try:
        found = interval_at(at_us * 1000, exchanges)
    except ClockMoved:
        assert not inner
        return
    assert outer[0] - 2.1 <= found.lo_ns
    assert found.hi_ns <= outer[1] + 2.1
    if inner:
        assert found.lo_ns <= inner[0] - 0.5
        assert inner[1] + 0.5 <= found.hi_ns


def test_with_more_bounds_than_count_an_interval_still_holds_the_offset() -> None:
    """Upper bounds on a parabola are all vertices; some 100 of 600 count, and so do the last 2000 exchanges."""
    exchanges = [Exchange(at, at + (at // 1000) ** 2, at, at + 10) for at in range(-300_000, 300_000, 1000)]
    found, tight = interval_at(0, exchanges), best(0, exchanges, 0)
    assert found.lo_ns <= tight[0] <= tight[1] <= found.hi_ns <= tight[1] + 40
    offset = Offset()
    for at in (-10, *range(KEPT)):
        offset.add(Exchange(at, at + 500 * (at >= 0), at, at))
    assert offset.over(0).hi_ns > 490


def test_only_exchanges_within_a_window_around_an_instant_count() -> None:
    """The middle of the window is the instant, its end at most the last exchange."""
    offset, half_ns = Offset(), WINDOW_NS // 2
    for at_ns, width_ns in ((0, 9000), (half_ns - 10, 100), (half_ns, 10), (3 * half_ns, 1000)):
        offset.add(Exchange(at_ns, at_ns + width_ns, at_ns, at_ns))
    assert offset.over(half_ns - 1).hi_ns == pytest.approx(10, abs=2)
    assert offset.over(-half_ns + 5).hi_ns > half_ns * RATE / 1.1  # the first alone
    assert offset.over(3 * half_ns).hi_ns == pytest.approx(1000, abs=2)
    assert offset.over(half_ns, 3 * half_ns).hi_ns == pytest.approx(1000, abs=2)
    assert offset.over(half_ns - 9, half_ns).lo_ns == pytest.approx(0, abs=2)


REAL_NS = 17 * 10**17


@dataclass
class Elsewhere:
    """A server with another clock, in virtual time: an exchange takes 8 ms up and 1 ms down."""

    clock: VirtualClock
    ahead_ns: int = 0
    drift: float = 0.0
    wall_off_ns: int = 0
    """By how much its wall clock is off, and how much it says it may be."""
    wall_error_ns: int = 0
    busy_ns: int = 2 * MS_NS
    asked: list[tuple[int, str]] = field(default_factory=list)
    fails: bool = False

    def offset(self, at_ns: int) -> int:
        return self.ahead_ns + round(self.drift * at_ns)

    def there(self, at_ns: int) -> int:
        return at_ns + self.offset(at_ns)

    def exchange(self, system: str = "", frame_ns: int | None = None) -> Trace:
        """Answer a request, after one more mark of the client, and one of a frame that came at ``frame_ns``."""
        sent_ns = self.clock.now_ns()
        self.asked.append((sent_ns, system))
        if self.fails:
            raise RequestFailed("gone")
        came_ns = sent_ns + 8 * MS_NS
        left_ns = came_ns + self.busy_ns
        seen_ns = left_ns + MS_NS
        self.clock.sleep_until_ns(seen_ns)
        marks = [(stage, self.there(at)) for stage, at in (("network", came_ns), ("inference", left_ns))]
        frames = [] if frame_ns is None else [("", self.there(frame_ns)), ("decode", self.there(frame_ns + MS_NS))]
        real_ms = (REAL_NS - self.offset(left_ns) + self.wall_off_ns) / 1e6
        facts = {REALTIME_MS: real_ms, REALTIME_ERROR_MS: self.wall_error_ns / 1e6} if system else {}
        remote = Remote("elsewhere", marks, [marks[-1][1]], frame_marks=frames, facts=facts)
        trace = Trace([("", sent_ns - MS_NS), ("pack", sent_ns), ("return", seen_ns)])
        trace.receive(remote)
        return trace


@pytest.fixture
def virtual(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    clock = VirtualClock(100 * SECOND_NS)
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.clocks.now_ns", clock.now_ns)
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.clocks.SystemClock", lambda: clock)
    return clock


@pytest.mark.parametrize("drift", [-5e-5, 0, 5e-5])
@pytest.mark.parametrize("ahead_ns", [-50 * SECOND_NS, 10**15])
def test_a_report_on_this_hosts_clock_is_off_by_no_more_than_it_says(
    virtual: VirtualClock, ahead_ns: int, drift: float
) -> None:
    server = Elsewhere(virtual, ahead_ns, drift)
    remote = RemoteClock(server.exchange, {})
    for number in range(30):
        sent_ns = virtual.now_ns()
        trace = server.exchange(frame_ns=sent_ns - 40 * SECOND_NS)
        virtual.sleep_until_ns(virtual.now_ns() + SECOND_NS)
        last_ns = virtual.now_ns()
        joined = remote.join(trace, last_ns)
        report = trace.remote
        assert report.clock == clock_id()
        for (_, stamp), true_ns in zip(report.marks, (sent_ns + 8 * MS_NS, sent_ns + 10 * MS_NS), strict=True):
            assert abs(stamp - true_ns) <= joined.error_ns
        (_, first), (_, second) = report.frame_marks
        for stamp, true_ns in ((first, sent_ns - 40 * SECOND_NS), (second, sent_ns - 40 * SECOND_NS + MS_NS)):
            assert stamp - joined.early_ns <= true_ns <= stamp + joined.late_ns
        shift_ns = server.there(sent_ns + 8 * MS_NS) - report.marks[0][1]
        assert joined.late_ns >= shift_ns - server.offset(last_ns)
        assert joined.early_ns >= server.offset(last_ns) - shift_ns
        assert joined.error_ns > 4.49 * MS_NS  # half of both delays, which no exchange tells
        assert joined.error_ns < (5.5 if number else 8) * MS_NS
        assert min(joined.early_ns, joined.late_ns) >= joined.error_ns - 1


@pytest.mark.parametrize("drift", [-0.09, 0.09])
def test_a_request_alone_bounds_the_offset_from_its_first_to_its_last_stamp(
    virtual: VirtualClock, drift: float
) -> None:
    """Its server is busy for so long that the clocks drift apart by more than both delays."""
    server = Elsewhere(virtual, 10**12, drift, busy_ns=2 * SECOND_NS)
    for _ in range(2):
        sent_ns, trace = virtual.now_ns(), server.exchange()
        joined = RemoteClock(server.exchange, None).join(trace, virtual.now_ns())
        came_ns = sent_ns + 8 * MS_NS
        for (_, stamp), true_ns in zip(trace.remote.marks, (came_ns, came_ns + 2 * SECOND_NS), strict=True):  # type: ignore[union-attr]
            assert abs(stamp - true_ns) <= joined.error_ns


@pytest.mark.parametrize("off", [-1, 0, 1])
def test_wall_clocks_that_are_off_by_all_that_they_say_still_hold_the_offset(
    virtual: VirtualClock, off: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Either host's clock may be off by its error, and wander by 10 ppm while a reading is up to 1 s old."""
    ours, theirs, wander = 300_000, 200_000, 10_000
    server = Elsewhere(virtual, 10**12, 0.0, -off * (theirs + wander), theirs)
    mine = WallClock(REAL_NS + off * (ours + wander), ours, 0)
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.clocks.WALL_CLOCKS", {"chrony": lambda: mine})
    offsets: dict[str, Offset] = {}
    remote = RemoteClock(server.exchange, offsets, "chrony")
    for _ in range(3):
        remote.join(server.exchange(), virtual.now_ns())
        found = offsets["elsewhere"].over(virtual.now_ns())
        assert found.lo_ns <= 10**12 <= found.hi_ns
        assert found.hi_ns - found.lo_ns <= 2 * (ours + theirs + 2 * wander) + 3000
        virtual.sleep_until_ns(virtual.now_ns() + 2 * SECOND_NS)
    systems = [system for _, system in server.asked]
    assert systems == ["", *[""] * 20, "chrony", *["", *[""] * 5, "chrony"] * 2]


def test_exchanges_are_made_over_a_second_when_met_and_then_in_one_burst_a_second(virtual: VirtualClock) -> None:
    server = Elsewhere(virtual, 7)
    remote = RemoteClock(server.exchange, {})
    remote.refresh()
    assert not server.asked
    remote.join(server.exchange(), virtual.now_ns())
    times = [at for at, _ in server.asked[1:]]
    assert [two - one for one, two in pairwise(times)] == [61 * MS_NS] * 19
    met_ns, counts = virtual.now_ns(), []
    for after_ns in (SECOND_NS, SECOND_NS + 1, SECOND_NS + 2, 3 * SECOND_NS):
        virtual.sleep_until_ns(met_ns + after_ns)
        remote.refresh()
        counts.append(len(server.asked) - 21)
    assert counts == [0, 5, 5, 10]
    server.fails = True
    virtual.sleep_until_ns(met_ns + 9 * SECOND_NS)
    remote.refresh()  # the next request meets what is wrong
    assert len(server.asked) == 21 + 11
    alone = RemoteClock(server.exchange, None)
    server.fails = False
    alone.join(server.exchange(), virtual.now_ns())
    virtual.sleep_until_ns(met_ns + 20 * SECOND_NS)
    alone.refresh()
    assert len(server.asked) == 21 + 12


def test_a_server_that_tells_less_than_its_wall_clock_or_no_marks_is_refused(
    virtual: VirtualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = Elsewhere(virtual)
    monkeypatch.setattr("s2a_bench.plugins.two_hosts.clocks.WALL_CLOCKS", {"ptp": lambda: WallClock(REAL_NS, 1, 0)})
    remote = RemoteClock(lambda _: server.exchange(), {}, "ptp")
    with pytest.raises(RequestFailed, match="`clock` ptp: the server does not tell its wall clock"):
        remote.join(server.exchange(), virtual.now_ns())
    for silent in (Trace(), Trace([("", 1), ("", 2)], remote=Remote("elsewhere"))):
        with pytest.raises(RequestFailed, match="no marks"):
            remote.join(silent, virtual.now_ns())


CHRONY = (
    "01020304,a.b.c,3,1328281229.000000000,-0.000001501,-0.000001632,0.000002360,331.898,0.004,0.154,"
    "0.373169000,0.024780000,64.2,Normal\n"
)
PTP = """sending: GET CURRENT_DATA_SET
\t90e2ba.fffe.20c7f8-0 seq 0 RESPONSE MANAGEMENT CURRENT_DATA_SET
\t\tstepsRemoved        1
\t\toffsetFromMaster  -142.0
\t\tmeanPathDelay     9310.0
"""


@pytest.fixture(autouse=True)
def nothing_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for each in (clocks.CHRONY, clocks.PTP):
        monkeypatch.setattr(each, "last", None)


def test_chronys_bound_is_the_root_distance_and_the_offset() -> None:
    assert clocks.chrony_error_s(CHRONY) == pytest.approx(1.501e-6 + 0.024780 + 0.373169 / 2)


def test_ptps_bound_is_the_offset_and_the_path() -> None:
    assert clocks.ptp_error_s(PTP) == pytest.approx(9452e-9)


@pytest.mark.parametrize(
    ("system", "output", "message"),
    [
        ("chrony", CHRONY.replace("Normal", "Not synchronised"), "chronyd is not synchronised (Not synchronised)"),
        ("chrony", "506 Cannot talk to daemon\n", "'chronyc -c tracking'"),
        ("ptp", "sending: GET CURRENT_DATA_SET\n", "'pmc -u -b 0 GET CURRENT_DATA_SET'"),
        ("ptp", FileNotFoundError("No such file"), "tells no bound on the host "),
    ],
)
def test_a_system_without_a_bound_is_one_line(
    system: str, output: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(command: tuple[str, ...], **_: Any) -> subprocess.CompletedProcess[str]:
        if isinstance(output, Exception):
            raise output
        return subprocess.CompletedProcess(command, 0, output, "")

    monkeypatch.setattr(clocks.subprocess, "run", run)
    with pytest.raises(RequestFailed, match="`clock` ") as error:
        WALL_CLOCKS[system]()
    assert message in str(error.value)


def test_a_reading_is_used_for_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []

    def run(command: tuple[str, ...], **_: Any) -> subprocess.CompletedProcess[str]:
        runs.append(command)
        return subprocess.CompletedProcess(command, 0, PTP, "")

    monkeypatch.setattr(clocks.subprocess, "run", run)
    monkeypatch.setattr(clocks, "FRESH_NS", 10**15)
    first = clocks.PTP()
    assert clocks.PTP() is first
    assert runs == [("pmc", "-u", "-b", "0", "GET CURRENT_DATA_SET")]
    assert first.error_ns >= 9452


def test_any_packages_wall_clock_may_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = EntryPoint("gps", "somebodys_gps:clock", WALL_CLOCKS.group)
    monkeypatch.setitem(WALL_CLOCKS._offered, "gps", offered)
    assert HostOptions(clock="gps").clock == "gps"
    with pytest.raises(UsageError, match="'sundial' is not one of chrony, ptp, gps"):
        HostOptions(clock="sundial")
