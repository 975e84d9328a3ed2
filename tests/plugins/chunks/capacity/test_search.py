"""The search for the largest fleet within a limit: its options, fleets tried, decisions, the knee with its interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.capacity.config import CapacityMeasured, CapacityPredicted, Limit
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace, measures
from s2a_bench.plugins.chunks.capacity.search import Judge, Knee, Tried, above_limit, knee, search
from s2a_bench.plugins.chunks.modes import ControlSetting, Ticks

MS = 1_000_000
SETTING = ControlSetting(20 * MS, 16)


@pytest.mark.parametrize("robots", ["1..64", "3..50", "1..1"])
def test_the_search_finds_every_knee_in_as_many_fleets_as_it_says(robots: str) -> None:
    plan = CapacityPredicted(predict="20", robots=robots).search
    for largest in range(70):
        attempts: list[int] = []

        def attempt(number: int, attempts: list[int] = attempts, largest: int = largest) -> Tried:
            attempts.append(number)
            return Tried(number, "below" if number <= largest else "above", number <= largest)

        tried: dict[int, Tried] = {}
        search(plan.numbers, attempt, tried, bisects=True)
        first, last = plan.numbers[0], plan.numbers[-1]
        found = min(1, largest) if largest < first else min(largest, last)
        high = None if largest >= last else first - 1 if found == 1 < first else found
        assert knee(tried.values()) == Knee(found, found, high)
        assert attempts == [*tried]
        assert len(attempts) <= plan.most_fleets


def test_a_list_is_tried_to_its_end_after_one_robot_alone() -> None:
    tried: dict[int, Tried] = {}
    search([2, 4], lambda number: Tried(number, "above", within=False), tried, bisects=False)
    assert [*tried] == [1, 2, 4]


B, U, A = "below", "undecided", "above"


@pytest.mark.parametrize(
    ("tried", "found"),
    [
        ([(1, B, True), (2, B, True), (4, A, False), (3, U, True)], Knee(3, 2, 3)),
        ([(1, B, True), (2, U, False), (4, A, False)], Knee(1, 1, 3)),
        ([(1, U, True), (2, U, True)], Knee(2, 0, None)),
        ([(1, A, False)], Knee(0, 0, 0)),
    ],
)
def test_undecided_fleets_are_inside_the_interval(tried: Any, found: Knee) -> None:
    assert knee(Tried(*each) for each in tried) == found


def test_a_fleet_that_the_generator_does_not_drive_is_no_measurement() -> None:
    driven = [Tried(1, "below", within=True), Tried(2, "below", within=True)]
    assert knee([*driven, Tried(4, "above", within=False, clean=False)]) == Knee(2, 2, None)
    assert knee([Tried(1, "below", within=True, clean=False)]) is None


def trace(robot: int, stalled: Any, latency_ms: Any) -> RobotTrace:
    """Make a trace of 1,000 ticks, 20 s, with a request each 200 ms."""
    chunk = np.where(stalled, -1, 0)
    age = np.where(stalled, -1, np.arange(chunk.size) % 16)
    ticks = Ticks(chunk, chunk, age, np.asarray(stalled))
    arrival_ns = np.where(np.array(latency_ms) < 0, -1, np.array(latency_ms) * MS)
    request_ns = np.arange(arrival_ns.size) * 200 * MS
    return RobotTrace(robot, 0, chunk.size * 20 * MS, request_ns, arrival_ns, ticks, arrival_ns)


def fleet(share: float, latency_ms: Any = (50,) * 100) -> list[RobotTrace]:
    rng = np.random.default_rng(0)
    return [trace(robot, rng.random(1000) < share, latency_ms) for robot in range(8)]


@pytest.mark.parametrize(
    ("share", "alone", "verdict"),
    [
        (0, 0, "below"),
        (0.002, 0, "below"),
        (0.01, 0, "undecided"),
        (0.05, 0, "above"),
        (0.05, 0.05, "undecided"),
        (0.05, 0.06, "below"),
    ],
)
def test_stalls_are_judged_by_their_interval_less_what_one_robot_has_alone(
    share: float, alone: float, verdict: str
) -> None:
    traces = fleet(share)
    row = measures(traces, SETTING)
    assert Judge(Limit.read("stalled=1%"), True, 0, 0.95, alone)(row, traces)[0] == verdict


@pytest.mark.parametrize(
    ("limit", "verdict"),
    [
        ("latency_p50=60ms", "below"),
        ("latency_p50=40ms", "above"),
        ("age_p99=400ms", "below"),
        ("age_p50=40ms", "above"),
    ],
)
def test_a_percentile_is_judged_by_the_share_of_values_above_it(limit: str, verdict: str) -> None:
    traces = fleet(0)
    assert Judge(Limit.read(limit), False, 0, 0.95)(measures(traces, SETTING), traces)[0] == verdict


def test_stalls_that_come_back_every_cycle_are_decided() -> None:
    cycle = np.arange(1000) % 19 < 3  # sync: 3 of 19 ticks
    traces = [trace(robot, np.roll(cycle, robot * 5), [50] * 100) for robot in range(8)]
    row = measures(traces, SETTING)
    assert Judge(Limit.read("stalled=2%"), True, 0, 0.99, 3 / 19)(row, traces)[0] == "below"
    assert Judge(Limit.read("stalled=2%"), True, 0, 0.99, 2 / 18)(row, traces)[0] == "above"


def test_a_request_without_an_answer_is_above_the_limit_once_it_waits_for_longer() -> None:
    latency_ms = [50] * 98 + [-1, -1]  # 400 and 200 ms before the end
    _, robots, above = above_limit(Limit.read("latency_p99=300ms"), [trace(3, [False] * 1000, latency_ms)], 5000 * MS)
    assert above.tolist() == [False] * 73 + [True]
    assert set(robots.tolist()) == {3}


@pytest.mark.parametrize(("stalled", "found"), [(0.2, ("below", True)), (0.8, ("above", False))])
def test_one_robot_alone_has_no_stalls_beyond_its_own_but_may_leave_no_room(stalled: float, found: Any) -> None:
    judge, traces = Judge(Limit.read("stalled=25%"), True, 0, 0.95), fleet(stalled)[:1]
    assert judge(measures(traces, SETTING), traces, first=True) == found
    assert judge.alone == pytest.approx(stalled, abs=0.05)


def test_without_values_nothing_is_decided() -> None:
    row = measures([], SETTING)
    assert Judge(Limit.read("stalled=1%"), False, 0, 0.95)(row, []) == ("undecided", False)
    assert Judge(Limit.read("ttft_p99=1s"), False, 0, 0.95)(row, []) == ("undecided", False)
    assert Judge(None, False, 0, 0.95)(row, []) == ("none", True)


@pytest.mark.parametrize(
    ("written", "numbers"),
    [("1..64", (1, 2, 4, 8, 16, 32, 64)), ("3..20", (3, 6, 12, 20)), ("5", (5,)), ("4,1,2", (1, 2, 4)), (7, (7,))],
)
def test_robots_are_a_range_a_list_or_a_number(written: Any, numbers: tuple[int, ...]) -> None:
    assert CapacityPredicted(predict="20", robots=written).search.numbers == numbers


@pytest.mark.parametrize(
    ("written", "limit"),
    [
        ("stalled=1%", Limit("stalled", 0.01, 0.01)),
        ("stalled=0.02", Limit("stalled", 0.02, 0.02)),
        ("latency_p50=0.3s", Limit("latency_p50_ns", 3e8, 0.5)),
        ("ttft_p99=300ms", Limit("ttft_p99_ns", 3e8, 1 - 0.99)),
    ],
)
def test_a_limit_is_a_share_of_values_that_may_be_above_it(written: str, limit: Limit) -> None:
    assert CapacityPredicted(predict="20", limit=written, plan_every_s=1).search.limit == limit


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robots": "0"}, "`robots`: '0' should be 1 or more"),
        ({"robots": "many"}, "`robots`: 'many' should be 1 or more: a number, a list, or FROM..TO"),
        ({"robots": "100000"}, "`robots`: 100000 are more than"),
        ({"limit": "stalled=2"}, "`limit`: 'stalled=2' allows every tick to stall"),
        ({"limit": "stalled=a"}, "`limit`: 'stalled=a' should be one of"),
        ({"limit": "stalled=1%", "closed_loop": True}, "`limit`: a client without a clock never stalls"),
        ({"limit": "age_p99=1s", "closed_loop": True}, "`limit`: only an action has an age"),
        ({"think_s": 1}, "`think` needs `closed_loop`"),
        ({"modes": "sync", "closed_loop": True}, "`modes` are ways to act on chunks"),
        ({"modes": "wait"}, "`modes`: 'wait' is not one of sync, queue"),
        ({"modes": "queue?execute=20"}, "`modes`: queue?execute=20: a chunk has 16 actions"),
        ({"episodes_s": 0.01}, "`episodes`: 0.01 s need a control clock"),
        ({"episodes_s": 2, "settle_s": 5}, "`settle`: 5 s leave nothing of an episode of 2 s"),
        ({"predict": "20", "plan_every_s": 60}, "`seconds`: 10 s are too short for one plan every 60 s; take 180"),
        ({"predict": "20", "plan_every_s": 2, "episodes_s": 5}, "`episodes`: 5 s are too short for one plan every 2 s"),
        (
            {"predict": "20", "plan_every_s": 2, "episodes_s": 7, "settle_s": 5},
            "`episodes`: 2 s are too short for one plan every 2 s",
        ),
        ({"servers": 2}, "`servers` is not one of the options"),
        ({"ray": "auto"}, "`ray`: robots on other hosts need a server that they reach; name it with `url`"),
        ({"modes": "replace?under_way=many"}, "`modes`: replace?under_way=many has several requests under way"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_line(given: dict[str, Any], message: str) -> None:
    options = CapacityPredicted if "predict" in given else CapacityMeasured
    with pytest.raises(UsageError) as error:
        options(**given)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("given", "mode", "text"),
    [
        ({}, "queue?trigger=8", "at most 1 % stalled ticks"),
        ({"modes": "sync"}, "sync", "at most 1 % stalled ticks beyond those of one robot alone"),
        ({"plan_every_s": 1}, "", "at most 1 % stalled plans"),
        ({"limit": "latency_p99=0.3s"}, "queue?trigger=8", "latency p99 of at most 300 ms"),
        ({"limit": ""}, "queue?trigger=8", ""),
    ],
)
def test_a_limit_in_words_names_what_stalls(given: dict[str, Any], mode: str, text: str) -> None:
    config = CapacityPredicted(predict="20", **given)
    (load,), limit = config.loads, config.search.limit
    assert (load.name, load.limit_text(limit) if limit else "") == (mode, text)


@pytest.mark.parametrize(
    ("given", "load"),
    [
        ({}, "chunks"),
        ({"requests": {"transports": "loopback"}}, "chunks"),
        ({"requests": {"transports": "loopback"}, "plan_every_s": 1}, "plans"),
        ({"requests": {"transports": "http/llama-server"}}, "plans"),
        ({"closed_loop": True}, "closed"),
    ],
)
def test_what_robots_do_follows_from_what_the_server_answers(given: dict[str, Any], load: str) -> None:
    config = CapacityMeasured(**given)
    assert config.load == load
    assert (config.robots_requests.engine.answer == "tokens") == (load == "plans")


def test_all_looks_at_all_fleets_of_a_search_are_right_with_95_percent() -> None:
    """One of 1 to 64 robots: seven fleets that double, six of the bisection, four looks each."""
    many, one = ({"robots": "1..64", "looks": 4}, {"robots": "1", "looks": 1})
    search, alone = (CapacityPredicted(predict="20", **given).search for given in (many, one))
    assert (search.most_fleets, alone.most_fleets) == (13, 1)
    assert 1 - search.confidence == pytest.approx(0.05 / (13 * 4))
    assert alone.confidence == pytest.approx(0.95)
