"""Link profiles: their names, files and pairs, their traces, and the bound that follows."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from s2a_bench.boards.links import Direction, Step, bound_s, load_link, published
from s2a_bench.errors import UsageError


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
    text: str,
    up: float,
    down: float,
    delay_ms: float,
    loss: float,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text('up_mbps = 5\ndelay_ms = 1\nsource = "mine"\n')
    profile = load_link(text)
    ways = profile.directions()
    assert ([way.mbps for way in ways], profile.name) == ([up, down], name)
    assert {(way.delay_ms, way.loss) for way in ways} == {(delay_ms, loss)}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("4", "'4' is none of"),
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


def test_a_csv_trace_gives_both_directions_their_steps(tmp_path: Path) -> None:
    path = tmp_path / "ride.csv"
    path.write_text("t_s,up_mbps,down_mbps,delay_ms,loss\n0,10,20,5,0\n1,0,40,7,0.5\n")
    up, down = load_link(str(path)).directions()
    assert up.steps == (Step(0, 10, 5, 0), Step(1, 0, 7, 0.5))
    assert (down.mbps, down.delay_ms, down.period_s) == (40, 5, 2)


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


def test_each_opportunity_of_mahimahi_carries_1500_bytes_in_the_ms_that_ends_then(tmp_path: Path) -> None:
    path = tmp_path / "cell.up"
    path.write_text("1\n1\n4\n")
    up, down = load_link(f"up_trace={path},down=8").directions()
    assert [(step.start_s, step.mbps) for step in up.steps] == [(0, 24), (0.001, 0), (0.003, 12)]
    assert (up.period_s, down.steps) == (0.004, ())
    path.write_text("3\n2\n")
    with pytest.raises(UsageError, match="line 2"):
        load_link(f"up_trace={path}").directions()


def test_a_synthetic_link_repeats_by_its_seed_and_has_its_mean_and_outages() -> None:
    profile = load_link("rate=50,rate_cv=0.5,outage_every_s=20,seed=3")
    up, down = profile.directions()
    assert up == profile.directions()[0] != load_link("rate=50,rate_cv=0.5,outage_every_s=20,seed=4").directions()[0]
    running = [step.mbps for step in up.steps if step.mbps]
    assert 40 < sum(running) / len(running) < 60
    assert [step.mbps == 0 for step in up.steps] == [step.mbps == 0 for step in down.steps]
    assert len(running) < len(up.steps) == 6000


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
    assert bound_s((up, Direction(8.0)), size) == pytest.approx(bound)
    assert bound_s((up, Direction(8.0, delay_ms=7)), size, 1000) == pytest.approx(bound + 0.008)
