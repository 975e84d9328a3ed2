"""Advice on a transport for a link: its sum, its interval, its order and its sentence."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.experiments import Experiment
from s2a_bench.experiments.latency.view.against_bytes import FittedPipeline
from s2a_bench.plugins.two_hosts.advise import AdviseConfig
from s2a_bench.plugins.two_hosts.advise import prediction as room
from s2a_bench.plugins.two_hosts.advise.prediction import (
    Advice,
    Tcp,
    advice_json,
    advice_table,
    advise,
    host_tcp,
    sentence,
    tcp_adds_ms,
    waiting_ms,
)
from s2a_bench.plugins.two_hosts.links.relay import Shaper
from s2a_bench.plugins.two_hosts.profiles import Direction, load_link
from s2a_bench.stats.line import Estimate, Line
from s2a_bench.writers.tables import ABSENT
from tests.cli.program import called

LINK = "rate=12/24,delay=5"
CUBIC, BBR = Tcp("cubic", slow_start_after_idle=True), Tcp("bbr", slow_start_after_idle=True)
FITTED = room.fitted
REFERENCE = Path(__file__).parents[3] / "results" / "reference" / "transports"


@pytest.fixture(scope="module", autouse=True)
def read_once() -> Iterator[None]:
    """Read the reference sweep once: some 20 runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "fitted", cache(room.fitted))
        patch.setattr(room, "host_tcp", lambda: CUBIC)
        yield


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
        (3000, 240, 251 + 150, 0, 50 - 25),  # the link holds 1,000 of them
        (80, 12, 600 + 80, 50 - 27, (50 - 12) + (50 - 24)),  # a quarter of 80 and 27
    ],
)
def test_after_idle_a_body_waits_for_the_rest_of_each_round_trip_that_its_window_does_not_fill(
    packets: int, mbps: float, period_ms: float, least_ms: float, most_ms: float
) -> None:
    link, size = (Direction(mbps, 25), Direction(mbps, 25)), (packets - 0.001) * PACKET
    assert tcp_adds_ms(size, link, period_ms, CUBIC) == pytest.approx((least_ms, most_ms), abs=1e-6)
    assert tcp_adds_ms(size, link, period_ms, replace(CUBIC, slow_start_after_idle=False)) == (0, 0)
    assert tcp_adds_ms(size, link, 0, CUBIC) == (0, 0)
    assert tcp_adds_ms(size, link, period_ms, BBR) == tcp_adds_ms(size, link, 0, BBR)


def test_slow_start_after_idle_ranks_datagrams_before_tcp() -> None:
    busy, idle = ({each.name: each for each in advise(AdviseConfig(link="4g", rate=rate))[0]} for rate in (0, 1))
    tcp, udp = "http/binary?payload=jpeg", "ros/topic?payload=jpeg"
    assert idle[udp].e2e_ms == busy[udp].e2e_ms
    assert idle[tcp].e2e_ms > busy[tcp].e2e_ms + 50
    assert next(iter(idle)) == udp


@pytest.mark.parametrize("load", [0.02, 0.06, 0.2, 0.3, 0.5, 0.92])
def test_at_most_a_share_of_random_requests_waits_longer(load: float) -> None:
    """Poisson arrivals wait by Lindley's recursion, 10 ms a request; those of two robots wait for one request."""
    count, random = 200_000, np.random.default_rng(1)
    wait_ms = waiting_ms(load, 10)
    steps = np.cumsum(10 - random.exponential(10 / load, count))
    waits = steps - np.minimum(np.minimum.accumulate(steps), 0)
    if 0.05 < load < 0.28:  # exact, below the time of one request
        assert np.mean(waits > wait_ms) == pytest.approx(room.WAITS, abs=0.002)
        return
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
    low, high, all_ms = *one.ends_ms, one.ends_ms[1] + one.wait_ms

    def meets(deadline_ms: float) -> bool | None:
        found, *_ = advise(AdviseConfig(link=LINK, rate=4, deadline=f"{deadline_ms:.6f}ms"))
        return next(each.meets for each in found if each.name == one.name)

    assert [meets(low - 0.01), meets(low + 0.01), meets(high), meets(all_ms - 0.01)] == [False, None, None, None]
    assert meets(all_ms + 0.01)


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


def line(fixed: float, slope: float, spread: float | None = 0.1) -> Line:
    return Line(Estimate(fixed, None), Estimate(slope, None), 0.0, spread, (0.5, 0.25, 1.0))


RAW = FittedPipeline(
    "websocket/openpi", "raw", ("websocket/openpi", ""), {}, [], [], line(4, 10), line(1, 2), 1.0, has_ingest=False
)


def with_lines(patch: pytest.MonkeyPatch, *lines: FittedPipeline, tcp: Tcp = CUBIC) -> None:
    patch.setattr(room, "fitted", lambda _: ([*lines], "the sweep's."))
    patch.setattr(room, "host_tcp", lambda: tcp)


BODY = 640 * 480 * 3


def carried_ms(up: Direction, down: Direction) -> float:
    """Return how long a body and its answer take by the relay's rules."""
    ways = [Shaper(replace(way, queue_ms=1e9)) for way in (up, down)]
    full, rest = divmod(round(BODY * room.HEADERS), 1500)
    came_s = [ways[0].due_s(0.0, size) for size in (*[1500] * full, rest)][-1]
    answered_s = ways[1].due_s(came_s, 60)
    return answered_s * 1e3


@pytest.mark.parametrize(
    "text", ["rate=12/24,delay=5", "rate=90,delay=20,jitter=9", "rate=20,burst_kib=300,burst_mbps=90"]
)
def test_a_link_that_is_off_by_all_that_it_may_be_ends_in_the_interval(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rates by 5 %, delays by .3 ms and 5 %, any jitter, and the sweep's work at either end of its line."""
    with_lines(monkeypatch, RAW)
    (one,), profile, _ = advise(AdviseConfig(link=text))
    up, down = profile.directions()
    work_ms, reach_ms = RAW.line.at(BODY / 1e6), RAW.line.reach(BODY / 1e6)  # type: ignore[union-attr]
    found = []
    for sign, jitter in ((-1, 0.0), (1, 1.0)):
        shares = {"mbps": 1 - 0.047 * sign, "burst_mbps": 1 - 0.047 * sign}
        ways = [
            replace(
                way,
                **{name: getattr(way, name) * share for name, share in shares.items()},
                delay_ms=max(0.0, way.delay_ms + sign * (0.29 + 0.05 * way.delay_ms) + jitter * way.jitter_ms),
                jitter_ms=0.0,
            )
            for way in (up, down)
        ]
        found.append(carried_ms(ways[0], ways[1]) + work_ms + sign * reach_ms)
    assert one.ends_ms[0] <= found[0] < found[1] <= one.ends_ms[1]
    assert found[1] - found[0] > 0.85 * (one.ends_ms[1] - one.ends_ms[0])
    exact_ms = carried_ms(up, down)
    assert one.bound_ms <= exact_ms
    assert one.link_ms == pytest.approx(exact_ms, abs=0.1 + (up.jitter_ms + down.jitter_ms) / 2)
    assert one.coding_ms == pytest.approx(1 + 2 * BODY / 1e6)
    assert one.e2e_ms == pytest.approx(work_ms + one.link_ms)


def test_a_prediction_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pictures of 100 x 100, a twelfth of them on the wire: 5 kB take 10 ms at 4 Mbit/s, with headers 10.36."""
    pipeline = replace(RAW, wire_share=1 / 12, coding=None)
    with_lines(monkeypatch, pipeline, tcp=replace(CUBIC, slow_start_after_idle=False))
    config = AdviseConfig(link="rate=4/8,delay=3,jitter=2", rate=20, size=(100, 100), cameras=2)
    (one,), *_ = advise(config)
    link_ms = 10 * 1500 / 1448 + 2 * 3 + 2 * 1
    assert (one.bound_ms, one.link_ms) == (pytest.approx(16), pytest.approx(link_ms))
    assert one.load == pytest.approx(0.2 * 1500 / 1448)
    assert one.wait_ms == pytest.approx(waiting_ms(one.load, 10 * room.HEADERS))
    assert one.e2e_ms == pytest.approx(4.6 + link_ms)
    reach_ms = 0.1 * math.sqrt(4.6**2 + 0.5 + 2 * 0.25 * 0.06 + 0.06**2)
    off_ms = 2 * 0.3 + 0.05 * link_ms + 2
    assert one.ends_ms == pytest.approx((one.e2e_ms - reach_ms - off_ms, one.e2e_ms + reach_ms + off_ms))
    assert (one.coding_ms, one.limit, one.meets) == (0, "link", True)
    with_lines(monkeypatch, replace(pipeline, line=line(4, 10, None)))
    (open_end,), *_ = advise(config)
    assert (open_end.ends_ms, open_end.e2e_ms) == (None, pytest.approx(one.e2e_ms))
    for deadline_ms, meets in ((one.e2e_ms - 0.1, False), (one.e2e_ms + 0.1, None), (1000, True)):
        (open_end,), *_ = advise(config.model_copy(update={"deadline": f"{deadline_ms:.3f}ms"}))
        assert open_end.meets is meets


def test_an_unlimited_link_has_no_load_and_an_interval_does_not_begin_before_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with_lines(monkeypatch, replace(RAW, line=line(0.1, 0, 2.0)))
    (one,), *_ = advise(AdviseConfig(link="delay=0", rate=100))
    assert (one.load, one.wait_ms, one.meets) == (0, 0, True)
    assert one.ends_ms[0] == 0


def test_carried_ones_come_first_then_those_that_may_meet_the_deadline_then_the_quicker(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lines = [replace(RAW, payload=name, line=line(fixed, 0), wire_share=share) for name, fixed, share in ROWS]
    with_lines(monkeypatch, *lines, replace(RAW, line=None))
    found, *_ = advise(AdviseConfig(link="rate=12", rate=2, deadline="330ms"))
    assert [each.payload for each in found] == ["quick", "slow", "late", "heavy"]
    assert [each.meets for each in found] == [True, True, False, False]
    with_lines(monkeypatch, replace(RAW, line=None))
    with pytest.raises(UsageError, match="no pipeline with pictures of two sizes"):
        advise(AdviseConfig(link="rate=12"))


ROWS = (("late", 400, 0.01), ("slow", 9, 0.05), ("heavy", 1, 0.9), ("quick", 1, 0.05))


def advice(**changed: Any) -> Advice:
    values = {"pipeline": "zmq/msgpack", "payload": "raw", "e2e_ms": 20.0, "ends_ms": (15.0, 25.0), "link_ms": 12.0}
    values |= {"coding_ms": 3.0, "bound_ms": 11.0, "load": 0.25, "wait_ms": 7.0, "meets": True}
    return Advice(**{**values, **changed})


def test_what_is_measured_is_inside_up_to_both_ends_and_the_limit_is_the_largest_part() -> None:
    measured = [advice(measured_ms=ms).inside for ms in (14.9, 15, 25, 25.1, None)]
    assert measured == [False, True, True, False, None]
    assert advice(ends_ms=None, measured_ms=15).inside is None
    parts = ((6, 5, "transport"), (6, 9, "coding"), (12, 1, "link"), (8, 4, "link"), (7, 6, "link"))
    for link_ms, coding_ms, limit in parts:
        assert advice(link_ms=link_ms, coding_ms=coding_ms).limit == limit
    assert advice().name == "zmq/msgpack?payload=raw"
    assert advice(pipeline="ros/topic?middleware=zenoh").name == "ros/topic?middleware=zenoh&payload=raw"


@pytest.mark.parametrize(
    ("options", "more", "cells"),
    [
        ({"rate": 3}, ["of the rate", "wait ms", "meets it"], ["25%", "7.00", "yes"]),
        ({"deadline": "1s"}, ["meets it"], ["yes"]),
        ({"rate": 3, "deadline": "1s"}, ["of the rate", "wait ms", "meets it"], ["25%", "7.00", "yes"]),
    ],
)
def test_the_table_has_what_was_asked(options: dict[str, Any], more: list[str], cells: list[str]) -> None:
    config, profile = AdviseConfig(link=LINK, cameras=2, **options), load_link(LINK)
    found = [advice(), advice(wait_ms=None, meets=None, ends_ms=None), advice(meets=False)]
    table = advice_table(found, config, profile, "here")
    assert [*table.header] == ["pipeline", "payload", "predicted ms", "bound ms", "limited by", *more]
    assert [*table.rows[0]] == ["zmq/msgpack", "raw", "20.0 [15.0, 25.0]", "11.0", "link", *cells]
    assert table.rows[1][2] == "20.0"
    if more:
        assert [row[-1] for row in table.rows] == ["yes", "unclear", "no"]
    assert (ABSENT in table.rows[1]) == ("wait ms" in more) == (room.WAIT in table.notes)
    assert table.title == f"2 x 640x480 over {LINK} (the user's), predicted"
    assert not any("Losses" in note for note in table.notes)
    lossy = advice_table(found, config, load_link("loss=1%"), "here")
    assert lossy.notes[-1].startswith("Losses are not predicted")
    assert table.provenance == "here"
    beside = [advice(measured_ms=20.0), advice(measured_ms=99.0), advice(measured_ms=20.0, ends_ms=None), advice()]
    measured = advice_table(beside, config, profile, "")
    assert measured.header[3] == "measured ms"
    assert [row[3] for row in measured.rows] == ["20.0, inside", "99.0, outside", "20.0", ABSENT]
    assert any(note.startswith("TCP: cubic, slow start after idle on, as this host's; ") for note in table.notes)


def test_the_sentence_counts_those_that_surely_meet_the_deadline() -> None:
    profile, found = load_link("4g"), [advice(), advice(meets=None), advice(meets=False)]
    tcp = "; the link takes the most of it, if TCP is cubic, slow start after idle on and requests "
    quickest = "zmq/msgpack with raw is the quickest over 4g: 20.0 [15.0, 25.0] ms"
    plain = sentence(found, AdviseConfig(link="4g"), profile)
    assert plain == f"{quickest}{tcp}follow one another without a pause."
    asked = sentence(found, AdviseConfig(link="4g", rate=4, deadline="0.1s"), profile)
    assert asked == f"{quickest}; 1 of 3 surely meet 100 ms{tcp}come every 250 ms."
    assert "4g: 20.0 ms; the link" in sentence([advice(ends_ms=None)], AdviseConfig(link="4g"), profile)
    assert sentence([advice(load=1.0)], AdviseConfig(link="4g", rate=4), profile).startswith("zmq/msgpack")
    none = sentence([advice(load=1.01)], AdviseConfig(link="4g", rate=4), profile)
    assert none == "4g carries 4 such requests a second over no transport of the sweep."
    whole = advice_json(found, AdviseConfig(link="4g"), profile, "here")
    assert (whole["schema"], whole["command"], whole["provenance"]) == ("s2a-bench-advise/1", "advise", "here")
    assert (whole["cells"][0]["limit"], whole["cells"][0]["load"], whole["link"]["up_mbps"]) == ("link", 0.25, 18.75)
    assert whole["tcp"] == {"congestion_control": "cubic", "slow_start_after_idle": True}


def test_options_are_read_in_their_units() -> None:
    config = AdviseConfig(link="4g")
    assert (config.deadline_ms, config.period_ms, config.pixels_mb) == (math.inf, 0, 640 * 480 * 3 / 1e6)
    assert (config.rate, config.deadline, config.cameras, config.measure) == (0, "", 1, False)
    assert [path.name for path in config.runs] == ["transports"]
    times = {"100ms": 100, "0.5s": 500, "2s": 2000, "1.25ms": 1.25}
    assert {text: AdviseConfig(link="4g", deadline=text).deadline_ms for text in times} == times
    assert AdviseConfig(link="4g", rate=4).period_ms == 250
    assert AdviseConfig(link="4g", size=(10, 20), cameras=3).pixels_mb == pytest.approx(1800e-6)
    for wrong in ({"rate": -1}, {"rate": 10_001}, {"cameras": 0}, {"cameras": 17}, {"deadline": "5 ms"}):
        with pytest.raises(UsageError):
            AdviseConfig(**{"link": "4g", **wrong})


def test_the_hosts_tcp_is_read_from_its_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "Path", lambda _: tmp_path)
    assert host_tcp() == Tcp("cubic", slow_start_after_idle=True)
    for text, slow in (("0\n", False), ("1\n", True)):
        (tmp_path / "tcp_congestion_control").write_text("reno\n")
        (tmp_path / "tcp_slow_start_after_idle").write_text(text)
        assert host_tcp() == Tcp("reno", slow)
    assert str(Tcp("reno", slow_start_after_idle=False)) == "reno, slow start after idle off"


def test_only_pipelines_over_a_network_of_runs_without_a_link_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = {
        name: SimpleNamespace(manifest={"configuration": {"link": name} if name else {}}, origins=name)
        for name in ("", "4g")
    }
    seen: list[Any] = []
    lines = [
        RAW,
        replace(RAW, wire_share=None),
        replace(RAW, has_ingest=True),
        replace(RAW, path=("iceoryx2", "")),
        replace(RAW, path=("loopback", "")),
    ]
    monkeypatch.setattr(room, "_runs", lambda path: [runs[""], runs["4g"]] if path == Path("a") else [runs[""]])
    monkeypatch.setattr(room, "cells_of", lambda run: run)
    monkeypatch.setattr(room, "against_bytes", lambda runs: seen.extend(runs) or lines)
    monkeypatch.setattr(room, "joined", lambda origins: SimpleNamespace(line=f"{[*origins]}"))
    assert FITTED((Path("a"), Path("b"))) == ([RAW], "['', '']")
    assert seen == [runs[""], runs[""]]
