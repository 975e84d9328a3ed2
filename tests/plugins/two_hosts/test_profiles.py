"""Link profiles: their names, files and pairs, their traces, and the bound that follows."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from itertools import groupby
from pathlib import Path
from statistics import correlation, fmean, pstdev

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.plugins.two_hosts.profiles import (
    DELAY_OFF_MS,
    OFF,
    Direction,
    LinkProfile,
    Step,
    bound_s,
    load_link,
    published,
)


def test_every_published_profile_has_a_source_and_two_directions() -> None:
    for name, profile in published().items():
        assert profile.name == name
        assert profile.source != "the user's"
        assert all(way.mbps > 0 for way in profile.directions())


@pytest.mark.parametrize(
    ("text", "up", "down", "delay_ms", "loss", "name"),
    [
        ("4g", 18.75, 75, 25, 0, "4g"),
        ("osrf-54,loss=10%,delay=2", 54, 54, 2, 0.1, "osrf-54,loss=10%,delay=2"),
        ("rate=20/100,jitter=1,loss=0.05", 20, 100, 0, 0.05, "rate=20/100,jitter=1,loss=0.05"),
        ("delay=10", math.inf, math.inf, 10, 0, "delay=10"),
        ("mine.toml", 5, math.inf, 1, 0, "mine"),
    ],
)
def test_a_link_is_a_name_a_file_or_pairs(
    text: str, up: float, down: float, delay_ms: float, loss: float, name: str, tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").write_text('up_mbps = 5\ndelay_ms = 1\nsource = "mine"\n')
    profile = load_link(text.replace("mine.toml", str(tmp_path / "mine.toml")))
    ways = profile.directions()
    assert ([way.mbps for way in ways], profile.name) == ([up, down], name)
    assert {(way.delay_ms, way.loss) for way in ways} == {(delay_ms, loss)}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("4", "'4' is not one of"),
        ("rate=x", "'rate=x' should be KEY=NUMBER"),
        ("rate=0", "up_mbps: 0.0 should be greater than 0"),
        ("loss=100%", "loss: 1.0 should be less than 1"),
        ("rat=3", "rat: there is no such key"),
        ("no.toml", "cannot read no.toml"),
        ("rate_cv=0.5", "needs a rate"),
        ("up_trace=no.up", "cannot read no.up"),
    ],
)
def test_what_is_no_link_is_one_line(text: str, problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        load_link(text).directions()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("t_s,up_mbps\n", "should name the column down_mbps"),
        ("t_s,up_mbps,down_mbps\n0,-1,2\n", "line 2: up_mbps -1 should be 0 to"),
        ("t_s,up_mbps,down_mbps\n0,x,2\n", "line 2"),
        ("t_s,up_mbps,down_mbps\n1,1,2\n", "start at 0"),
        ("t_s,up_mbps,down_mbps\n0,0,0\n", "and a rate"),
    ],
)
def test_a_wrong_trace_names_its_line(text: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "ride.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=problem):
        load_link(f"trace={path}").directions()


@pytest.mark.parametrize(
    ("up", "size", "bound"),
    [
        (Direction(8.0), 1_000_000, 1.0),
        (Direction(8.0, delay_ms=20), 1_000_000, 1.02),
        (Direction(8.0, burst_bytes=500_000, burst_mbps=80), 400_000, 0.04),
        (Direction(8.0, burst_bytes=500_000, burst_mbps=80), 1_000_000, 0.05 + 0.5),
        (Direction(math.inf, delay_ms=5), 1_000_000, 0.005),
    ],
)
def test_a_bound_is_the_delay_the_burst_and_the_rest_at_the_rate(up: Direction, size: int, bound: float) -> None:
    assert bound_s((up, Direction(8.0, delay_ms=7)), size) == pytest.approx(bound + 0.007)


def test_a_link_has_only_what_its_profile_names_and_every_key_reaches_its_direction() -> None:
    assert LinkProfile().directions() == (Direction(math.inf, seed=0), Direction(math.inf, seed=1))
    assert load_link("rate=5").directions() == (Direction(5), Direction(5, seed=1))
    pairs = "up=3,down=9,delay=4,jitter=6,loss=2%,burst_kib=10,burst_mbps=50,queue_ms=70,seed=8"
    up, down = load_link(pairs).directions()
    assert up == Direction(3, 4, 6, 0.02, 10 * 1024, 50, 70, 16)
    assert down == replace(up, mbps=9, seed=17)
    assert up.usual_ms == 7
    assert load_link("up=3,burst_kib=10").directions()[0].burst_mbps == math.inf
    assert load_link("up=3,burst_kib=10").directions()[1].burst_bytes == 0  # no rate that would limit it
    assert load_link("4g,loss=1%,seed=2").directions()[0] == replace(load_link("4g").directions()[0], loss=0.01, seed=4)
    assert load_link("rate=2,source=mine").about == "rate=2,source=mine (mine)"
    assert (OFF, DELAY_OFF_MS) == (0.05, 0.3)  # docs/links.md


def test_a_direction_is_read_back_from_its_facts() -> None:
    way = Direction(math.inf, 1, 2, 0.1, 3, 4, 5, 6, (Step(0, 1, 2, 0), Step(1, 3, 4, 0.5)), 7)
    facts = asdict(way)
    assert Direction.from_facts(facts) == way
    assert Direction.from_facts({**facts, "mbps": None}) == way


@pytest.mark.parametrize(
    ("key", "most", "beyond"),
    [
        ("rate", "1000000", "1000001"),
        ("delay", "60000", "60001"),
        ("delay", "0", "-1"),
        ("jitter", "60000", "60001"),
        ("loss", "0", "-0.1"),
        ("burst_kib", "1000000", "1000001"),
        ("burst_mbps", "1000000", "0"),
        ("queue_ms", "60000", "0"),
        ("rate_cv", "2", "2.1"),
        ("outage_every_s", "1000000", "-1"),
        ("seed", str(2**31 - 1), str(2**31)),
    ],
)
def test_every_key_has_its_limits(key: str, most: str, beyond: str) -> None:
    load_link(f"{key}={most}")
    with pytest.raises(UsageError, match="should be"):
        load_link(f"{key}={beyond}")


def test_a_trace_without_delay_and_loss_has_the_profiles_and_its_last_step_lasts_as_long_as_the_one_before(
    tmp_path: Path,
) -> None:
    path = tmp_path / "ride.csv"
    path.write_text("t_s,up_mbps,down_mbps\n0,10,20\n1,30,0\n4,5,6\n")
    up, down = load_link(f"{path},delay=3,loss=0.2").directions()
    assert up.steps == (Step(0, 10, 3, 0.2), Step(1, 30, 3, 0.2), Step(4, 5, 3, 0.2))
    assert [step.mbps for step in down.steps] == [20, 0, 6]
    assert (up.period_s, up.mbps, up.delay_ms) == (7, 30, 3)
    path.write_text("t_s,up_mbps,down_mbps,delay_ms,loss\n0,10,20,5,1\n1,0,40,7,0.5\n")
    assert load_link(str(path)).directions()[0].steps == (Step(0, 10, 5, 1), Step(1, 0, 7, 0.5))
    path.write_text("t_s,up_mbps,down_mbps,loss\n0,10,20,1\n")
    assert load_link(str(path)).directions()[0].period_s == 1
    for row in ("0,1,1\n1,1,1\n1,1,1", "0,1,1\\n1000000000.5,1,1", "0,1000000.5,1", "0,1"):
        path.write_text(f"t_s,up_mbps,down_mbps\n{row}\n")
        with pytest.raises(UsageError, match="link trace"):
            load_link(str(path)).directions()


def test_a_mahimahi_trace_carries_its_opportunities_in_each_period(tmp_path: Path) -> None:
    path, times = tmp_path / "cell", [0, 0, 1, 2, 2, 2, 5, 9, 9]
    path.write_text("4\n4\n")
    assert [(step.start_s, step.mbps) for step in load_link(f"up_trace={path}").directions()[0].steps] == [
        (0, 0),
        (0.003, 24),
    ]
    path.write_text("\n".join(map(str, times)))
    up, down = load_link(f"down_trace={path},delay=2,loss=0.1").directions()
    assert (up.steps, down.period_s, down.delay_ms) == ((), 0.009, 2)
    ends = [step.start_s for step in down.steps[1:]] + [down.period_s]
    carried = [step.mbps * (end - step.start_s) * 125e3 for step, end in zip(down.steps, ends, strict=True)]
    assert sum(carried) == pytest.approx(1500 * len(times))
    assert carried == pytest.approx([4500, 4500, 0, 1500, 0, 3000])
    assert {(step.delay_ms, step.loss) for step in down.steps} == {(2, 0.1)}
    for text in ("x\n", "1\n-2\n", "3\n2\n", "999999999999\n", ""):
        path.write_text(text)
        with pytest.raises(UsageError, match="link trace"):
            load_link(f"up_trace={path}").directions()


def test_a_synthetic_rate_has_its_mean_its_spread_and_its_memory_of_a_second() -> None:
    rates = [
        [step.mbps for step in load_link(f"rate=50,rate_cv=0.5,seed={seed}").directions()[seed % 2].steps]
        for seed in range(20)
    ]
    every = [rate for each in rates for rate in each]
    assert fmean(every) == pytest.approx(50, rel=0.03)
    assert pstdev(every) == pytest.approx(25, rel=0.08)
    logs = [[math.log(rate) for rate in each] for each in rates]
    assert fmean(correlation(each[10:], each[:-10]) for each in logs) == pytest.approx(math.exp(-1), abs=0.05)
    assert fmean(correlation(each[1:], each[:-1]) for each in logs) == pytest.approx(math.exp(-0.1), abs=0.02)
    up, down = load_link("rate=50,rate_cv=0.5").directions()
    assert up == load_link("rate=50,rate_cv=0.5").directions()[0]
    assert abs(correlation([step.mbps for step in up.steps], [step.mbps for step in down.steps])) < 0.2
    assert up.period_s == pytest.approx(600)
    assert [step.start_s for step in up.steps[:3]] == pytest.approx([0, 0.1, 0.2])


def test_outages_hit_both_directions_last_what_the_profile_says_and_leave_the_mean_time_between(tmp_path: Path) -> None:
    path = tmp_path / "lift.toml"
    path.write_text("up_mbps = 5\ndown_mbps = 6\ndelay_ms = 3\noutage_every_s = 4\noutage_s = [0.5, 1.5]\nloss = 0.1\n")
    lengths, gaps = [], []
    for seed in range(10):
        up, down = load_link(f"{path},seed={seed}").directions()
        assert {step.mbps for step in up.steps} == {0, 5}
        assert {(step.delay_ms, step.loss) for step in up.steps} == {(3, 0.1)}
        assert [not step.mbps for step in up.steps] == [not step.mbps for step in down.steps]
        runs = [(rate, len([*group]) * 0.1) for rate, group in groupby(step.mbps for step in up.steps)]
        gaps += [length for rate, length in runs[1:-1] if rate]
        lengths += [length for rate, length in runs[1:-1] if not rate]
        assert up.steps[0].mbps
    assert fmean(lengths) == pytest.approx(1.0, abs=0.1)
    assert 0.35 < min(lengths) < 0.7
    assert 1.3 < max(lengths) < 4
    assert fmean(gaps) == pytest.approx(4, rel=0.1)
    lasting = load_link("rate=5,outage_every_s=9").directions()[0]
    assert {round(len([*group]) * 0.1) for rate, group in groupby(step.mbps for step in lasting.steps) if not rate} <= {
        1,
        2,
    }
