"""Advice on a transport for a link: its sum, its interval, its order and its sentence."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from s2a_bench.boards.links import Direction
from s2a_bench.errors import UsageError
from s2a_bench.experiments import Experiment
from s2a_bench.report.advise import AdviseConfig
from s2a_bench.report.advise import prediction as room
from s2a_bench.report.advise.prediction import Tcp, advice_json, advice_table, advise, sentence, tcp_adds_ms, waiting_ms
from s2a_bench.writers.tables import ABSENT
from tests.cli.program import called

LINK = "rate=12/24,delay=5"
CUBIC, BBR = Tcp("cubic", slow_start_after_idle=True), Tcp("bbr", slow_start_after_idle=True)
REFERENCE = Path(__file__).parents[2] / "results" / "reference" / "transports"


@pytest.fixture(scope="module", autouse=True)
def read_once() -> Iterator[None]:
    """Read the reference sweep once: some 20 runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "fitted", cache(room.fitted))
        patch.setattr(room, "host_tcp", lambda: CUBIC)
        yield


@pytest.fixture(scope="module")
def over_wifi() -> Any:
    return advise(AdviseConfig(link=LINK))


def test_a_prediction_is_the_line_and_what_the_link_takes(over_wifi: Any) -> None:
    found, profile, origin = over_wifi
    raw = next(each for each in found if (each.pipeline, each.payload) == ("websocket/openpi", "raw"))
    pixels_s = 640 * 480 * 3 * 8e-6 / 12
    assert raw.bound_ms == pytest.approx(10 + pixels_s * 1e3, rel=0.01)
    assert raw.link_ms == pytest.approx(10 + pixels_s * 1e3 * room.HEADERS, rel=0.01)
    low, high = raw.ends_ms
    assert low < raw.e2e_ms < high
    assert raw.e2e_ms > raw.link_ms > raw.bound_ms
    assert raw.limit == "link"
    assert "PREDICTED" in origin
    assert profile.name == LINK


def test_bbr_paces_what_is_smaller_than_the_link_carries_in_a_round_trip(monkeypatch: pytest.MonkeyPatch) -> None:
    config = AdviseConfig(link="rate=1000,delay=20")
    plain = {each.name: each for each in advise(config)[0]}
    monkeypatch.setattr(room, "host_tcp", lambda: BBR)
    paced = {each.name: each for each in advise(config)[0]}
    tcp, udp = "websocket/openpi?payload=raw", "ros/topic?payload=raw"
    size_ms = plain[tcp].link_ms - 40
    assert paced[tcp].link_ms == pytest.approx(40 + 40 / 1.89)
    assert paced[tcp].ends_ms[1] - plain[tcp].ends_ms[1] == pytest.approx(1.55 * (40 / 1.89 - size_ms))
    assert paced[udp] == plain[udp]
    assert paced["ros/topic?middleware=zenoh&payload=raw"].link_ms == pytest.approx(40 + 40 / 1.89)


PACKET = 1500 / room.HEADERS
"""Bytes of a body in a packet."""


@pytest.mark.parametrize(
    ("packets", "mbps", "period_ms", "least_ms", "most_ms"),
    [
        (10, 12, 9999, 0, 0),  # the initial window holds it
        (11, 12, 9999, 40, 40),  # 50 ms a round trip less 10 packets of 1 ms
        (70, 12, 9999, 40 + 30, 40 + 30),  # windows of 10, 20, 40
        (900, 12, 9999, 80, 80),  # the window of 80 packets fills the link
        (70, float("inf"), 9999, 2 * 50, 2 * 50),
        (71, float("inf"), 9999, 3 * 50, 3 * 50),
        (80, 12, 249 + 80, 0, 0),  # idle for no more than the timeout: 200 ms and a round trip
        (80, 12, 251 + 80, 0, 50 - 25),  # halved: of 80 packets the link holds 50
        (80, 12, 501 + 80, 0, (50 - 12) + (50 - 24)),  # halved twice, if what this adds left it that idle
        (80, 12, 600 + 80, 50 - 27, (50 - 12) + (50 - 24)),  # a quarter of 80 and 27
    ],
)
def test_after_idle_a_body_waits_for_the_rest_of_each_round_trip_that_its_window_does_not_fill(
    packets: int, mbps: float, period_ms: float, least_ms: float, most_ms: float
) -> None:
    link, size = (Direction(mbps, 25), Direction(mbps, 25)), (packets - 0.001) * PACKET
    assert tcp_adds_ms(size, link, period_ms, CUBIC) == pytest.approx((least_ms, most_ms), abs=0.1)
    assert tcp_adds_ms(size, link, period_ms, replace(CUBIC, slow_start_after_idle=False)) == (0, 0)
    assert tcp_adds_ms(size, link, 0, CUBIC) == (0, 0)
    assert tcp_adds_ms(size, link, period_ms, BBR) == tcp_adds_ms(size, link, 0, BBR)


def test_slow_start_after_idle_ranks_datagrams_before_tcp() -> None:
    busy, idle = ({each.name: each for each in advise(AdviseConfig(link="4g", rate=rate))[0]} for rate in (0, 1))
    tcp, udp = "http/binary?payload=jpeg", "ros/topic?payload=jpeg"
    assert idle[udp].e2e_ms == busy[udp].e2e_ms
    assert idle[tcp].e2e_ms > busy[tcp].e2e_ms + 50
    assert next(iter(idle)) == udp


def test_the_tcp_that_was_assumed_is_named(over_wifi: Any) -> None:
    found, profile, origin = over_wifi
    config = AdviseConfig(link=LINK, rate=2)
    notes = advice_table(found, config, profile, origin).notes
    assert "TCP: cubic, slow start after idle on, as this host's; requests come each 500 ms." in notes
    whole = advice_json(found, AdviseConfig(link=LINK), profile, origin)
    assert whole["tcp"] == {"congestion_control": "cubic", "slow_start_after_idle": True}
    assert "if TCP is cubic, slow start after idle on and requests follow one another" in whole["sentence"]


@pytest.mark.parametrize("load", [0.02, 0.3, 0.5, 0.92])
def test_at_most_a_share_of_random_requests_waits_longer(load: float) -> None:
    """Poisson arrivals wait by Lindley's recursion, 10 ms a request; those of two robots wait for one request."""
    count, random = 200_000, np.random.default_rng(1)
    wait_ms = waiting_ms(load, 10)
    assert wait_ms is not None
    steps = np.cumsum(10 - random.exponential(10 / load, count))
    waits = steps - np.minimum(np.minimum.accumulate(steps), 0)
    assert np.mean(waits > wait_ms) <= room.WAITS
    if load >= 0.3:
        assert np.mean(waits > 0.6 * wait_ms) > room.WAITS
    if load == 0.92:  # as two robots: the later of two has the wait that the earlier's request leaves
        phases = random.uniform(0, 20 / load, count)
        assert np.mean(np.maximum(0, 10 - phases) > wait_ms) <= room.WAITS


def test_without_a_load_nothing_waits_and_at_the_rate_there_is_no_limit() -> None:
    assert [waiting_ms(load, 10) for load in (0, 0.05, 1, 3)] == [0, 0, None, None]


@pytest.mark.parametrize(("load", "meets"), [(0.49, True), (0.51, None), (0.99, None), (1.01, False)])
def test_a_rate_alone_is_surely_carried_up_to_its_half(load: float, meets: bool | None) -> None:
    (one, *_), *_ = advise(AdviseConfig(link="rate=12", rate=1))
    found, *_ = advise(AdviseConfig(link="rate=12", rate=load / one.load))
    assert next(each for each in found if each.name == one.name).meets is meets


def test_a_deadline_is_met_by_the_high_end_with_its_wait_and_missed_by_the_low_end() -> None:
    (one, *_), *_ = advise(AdviseConfig(link=LINK, rate=4))
    assert one.ends_ms
    assert one.wait_ms
    low, high, all_ms = *one.ends_ms, one.ends_ms[1] + one.wait_ms

    def meets(deadline_ms: float) -> bool | None:
        found, *_ = advise(AdviseConfig(link=LINK, rate=4, deadline=f"{deadline_ms:.6f}ms"))
        return next(each.meets for each in found if each.name == one.name)

    assert [meets(low - 0.01), meets(low + 0.01), meets(high), meets(all_ms - 0.01)] == [False, None, None, None]
    assert meets(all_ms + 0.01)


def test_the_load_and_the_interval_follow_from_the_links_rate_delay_and_jitter() -> None:
    plain, link = (advise(AdviseConfig(link=each, rate=2))[0] for each in ("rate=1e5", "rate=12,delay=5,jitter=6"))
    beside = {each.name: each for each in plain}
    for each in link:
        other = beside[each.name]
        assert each.load == pytest.approx((each.bound_ms - 10) * 2e-3 * room.HEADERS, rel=1e-3)
        assert each.ends_ms
        assert other.ends_ms
        assert each.wait_ms is None or each.load < 1
        tcp_ms = each.link_ms - 10 - 6 - (each.bound_ms - 10) * room.HEADERS  # two delays, half of each jitter
        assert tcp_ms >= -1e-3
        if tcp_ms < 1e-3:
            wider_ms = (each.ends_ms[1] - each.e2e_ms) - (other.ends_ms[1] - other.e2e_ms)
            assert wider_ms == pytest.approx(0.05 * (each.link_ms - other.link_ms) + 12 / 2, abs=1e-3)


def test_check_measures_with_the_pause_that_the_rate_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def run_with(_: Experiment, config: Any, *__: Any) -> Path:
        seen.append(config)
        raise UsageError("seen")

    monkeypatch.setattr(Experiment, "run_with", run_with)
    for rate in ("0", "2", "1000"):
        called("advise", "--link", LINK, "--rate", rate, "--check", code=2)
    first, second = (each.e2e_ms for each in advise(AdviseConfig(link=LINK, rate=2))[0][:2])
    assert [each.think_s for each in seen] == pytest.approx([0, 0.5 - max(first, second) / 1e3, 0])


def test_the_quickest_comes_first_and_pictures_that_the_rate_does_not_carry_last() -> None:
    found, *_ = advise(AdviseConfig(link=LINK, rate=4, deadline="500ms"))
    assert [each.load > 1 for each in found] == sorted(each.load > 1 for each in found)
    carried = [each for each in found if each.load <= 1]
    assert [each.e2e_ms for each in carried] == sorted(each.e2e_ms for each in carried)
    assert {each.payload for each in carried} == {"jpeg"}
    assert all(each.meets is False for each in found if each.load > 1)


def test_without_a_link_to_speak_of_the_coding_or_the_transport_is_the_limit() -> None:
    found, *_ = advise(AdviseConfig(link="rate=100000"))
    limits = {each.name: each.limit for each in found}
    assert limits["websocket/openpi?payload=jpeg"] == "coding"
    assert limits["http/as-deployed?payload=raw"] == "transport"


@pytest.mark.parametrize(("deadline", "meets"), [("10s", True), ("1ms", False)])
def test_a_deadline_is_met_where_the_interval_lies_on_one_side(deadline: str, meets: bool) -> None:
    found, *_ = advise(AdviseConfig(link=LINK, deadline=deadline))
    assert {each.meets for each in found} == {meets}


def test_what_was_measured_stands_beside_its_prediction(over_wifi: Any) -> None:
    found, profile, origin = over_wifi
    config = AdviseConfig(link=LINK)
    inside, outside = (replace(found[0], measured_ms=ms) for ms in (found[0].e2e_ms, found[0].e2e_ms * 3))
    table = advice_table([inside, outside, *found[1:]], config, profile, origin)
    at = table.header.index("measured ms")
    assert [re.sub(r"[\d.]+", "", row[at]) for row in table.rows[:3]] == [", inside", ", outside", ABSENT]
    assert [cell["inside"] for cell in advice_json([inside, outside], config, profile, origin)["cells"]] == [1, 0]


def test_the_sentence_names_the_quickest_or_that_none_is_carried(over_wifi: Any) -> None:
    found, profile, _ = over_wifi
    assert sentence(found, AdviseConfig(link=LINK), profile).startswith(
        f"{found[0].pipeline} with jpeg is the quickest"
    )
    config = AdviseConfig(link=LINK, rate=1000)
    assert "over no transport" in sentence(advise(config)[0], config, profile)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"deadline": "soon"}, "`deadline`: 'soon' should be a time"),
        ({"link": "wifi-roam"}, "changes with time"),
        ({"runs": (REFERENCE.parent / "chunks-live",)}, "run s2a-bench sweep transports"),
    ],
)
def test_what_cannot_be_advised_on_is_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)):
        advise(AdviseConfig(**{"link": LINK, **options}))


def test_the_command_prints_its_table_or_one_object() -> None:
    assert "websocket/openpi" in called("advise", "--link", LINK, "--deadline", "200ms").stdout
    whole = json.loads(called("advise", "--link", LINK, "--json").stdout)
    assert whole["cells"][0]["pipeline"]
