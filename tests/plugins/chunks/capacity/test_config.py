"""The options of a capacity run: what is read from text, and what makes no sense together."""

from __future__ import annotations

from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plugins.chunks.capacity.config import CapacityConfig, Limit


@pytest.mark.parametrize(
    ("written", "numbers"),
    [("1..64", (1, 2, 4, 8, 16, 32, 64)), ("3..20", (3, 6, 12, 20)), ("5", (5,)), ("4,1,2", (1, 2, 4)), (7, (7,))],
)
def test_robots_are_a_range_a_list_or_a_number(written: Any, numbers: tuple[int, ...]) -> None:
    assert CapacityConfig(robots=written).numbers == numbers


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
    assert CapacityConfig(limit=written, plan_every_s=1, requests={"transports": "loopback"}).limited == limit


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robots": "0"}, "`robots`: '0' should be 1 or more"),
        ({"robots": "0..4"}, "`robots`: '0..4' should be 1 or more"),
        ({"robots": "many"}, "`robots`: 'many' should be 1 or more: a number, a list, or FROM..TO"),
        ({"robots": "100000"}, "`robots`: 100000 are more than"),
        ({"limit": "stalled=2"}, "`limit`: 'stalled=2' allows every tick to stall"),
        ({"limit": "stalled=a"}, "`limit`: 'stalled=a' should be one of"),
        ({"limit": "stalled=1.2.3%"}, "`limit`: 'stalled=1.2.3%' should be one of"),
        ({"limit": "stalled=1%", "closed_loop": True}, "`limit`: a client without a clock never stalls"),
        ({"limit": "age_p99=1s", "closed_loop": True}, "`limit`: only an action has an age"),
        ({"think_s": 1}, "`think` needs `closed_loop`"),
        ({"modes": "sync", "closed_loop": True}, "`modes` are ways to act on chunks"),
        ({"modes": "wait"}, "`modes`: 'wait' is none of sync, queue"),
        ({"modes": "queue?execute=20"}, "`modes`: queue?execute=20: a chunk has 16 actions"),
        ({"episodes_s": 0.01}, "`episodes`: 0.01 s need a control clock"),
        ({"episodes_s": 2, "settle_s": 5}, "`settle`: 5 s leave nothing of an episode of 2 s"),
        ({"predict": "20", "plan_every_s": 60}, "`seconds`: 10 s are too short for one plan every 60 s; take 180"),
        ({"predict": "20", "plan_every_s": 2, "episodes_s": 5}, "`episodes`: 5 s are too short for one plan every 2 s"),
        (
            {"predict": "20", "plan_every_s": 2, "episodes_s": 7, "settle_s": 5},
            "`episodes`: 2 s are too short for one plan every 2 s",
        ),
        ({"predict": "20", "latency": "5"}, "`latency` is for a measured run"),
        ({"servers": 2}, "`servers` needs `predict`"),
        ({"predict": "20", "ray": "auto"}, "`ray` is for a measured run"),
        ({"ray": "auto"}, "`ray`: robots on other hosts need a server that they reach; name it with `url`"),
        ({"modes": "replace?under_way=many"}, "`modes`: replace?under_way=many has several requests under way"),
        ({"predict": "20", "requests": {"timeout_s": 3}}, "`timeout_s` is for a measured run"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_line(given: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        CapacityConfig(**given)
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
    assert CapacityConfig(predict="20", **given).limit_text(mode) == text


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
    config = CapacityConfig(**given)
    assert config.load == load
    assert (config.live_requests.engine.answer == "tokens") == (load == "plans")


def test_all_looks_at_all_fleets_of_a_search_are_right_with_95_percent() -> None:
    """One of 1 to 64 robots: seven fleets that double, six of the bisection, four looks each."""
    search, alone = CapacityConfig(robots="1..64", looks=4), CapacityConfig(robots="1", looks=1)
    assert (search.most_fleets, alone.most_fleets) == (13, 1)
    assert 1 - search.confidence == pytest.approx(0.05 / (13 * 4))
    assert alone.confidence == pytest.approx(0.95)
