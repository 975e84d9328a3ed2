"""Advice on a transport for a link: its sum, its interval, its order and its sentence."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.report.advise import AdviseConfig
from s2a_bench.report.advise import prediction as room
from s2a_bench.report.advise.prediction import advice_json, advice_table, advise, sentence
from s2a_bench.writers.tables import ABSENT
from tests.cli.program import called

LINK = "rate=12/24,delay=5"
REFERENCE = Path(__file__).parents[2] / "results" / "reference" / "transports"


@pytest.fixture(scope="module", autouse=True)
def read_once() -> Iterator[None]:
    """Read the reference sweep once: some 20 runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "fitted", cache(room.fitted))
        patch.setattr(room, "_congestion_control", lambda: "cubic")
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
    monkeypatch.setattr(room, "_congestion_control", lambda: "bbr")
    paced = {each.name: each for each in advise(config)[0]}
    tcp, udp = "websocket/openpi?payload=raw", "ros/topic?payload=raw"
    size_ms = plain[tcp].link_ms - 40
    assert paced[tcp].link_ms == pytest.approx(40 + 40 / 1.89)
    assert paced[tcp].ends_ms[1] - plain[tcp].ends_ms[1] == pytest.approx(1.5 * (40 / 1.89 - size_ms))
    assert paced[udp] == plain[udp]
    assert paced["ros/topic?middleware=zenoh&payload=raw"].link_ms == pytest.approx(40 + 40 / 1.89)


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
