"""Warnings about a run's validity."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from s2a_bench.facts import Fact
from s2a_bench.harness.session import INTERRUPTED
from s2a_bench.harness.warnings import Counters, SampleGuard
from s2a_bench.store.requests import SampleRow
from s2a_bench.trace import Mark
from s2a_bench.transport import Sleep, Transport, TransportOptions
from s2a_bench.transport.pipeline import Pipeline
from tests.made_runs import row_of

GOOD: list[Mark] = [("", 0), ("network", 90), ("", 91), ("inference", 500), ("return", 600)]
LOOSE: list[Mark] = [("", 0), ("network", 90), ("", 191), ("inference", 500), ("return", 600)]


class Advising(Transport[TransportOptions]):
    options = TransportOptions
    sleep = Sleep(Fact("wait_ms"), 1e3 / 30, "wake it")

    def against_loss(self, options: TransportOptions) -> str:  # noqa: ARG002 - as every transport has it
        return "export A=1"


CELL = Pipeline("ros/topic", Advising(), "topic", TransportOptions())


def row(request: str, cell: str = "ros/topic", **fields: Any) -> SampleRow:
    return row_of(cell, {}, 0, **{"request_id": request, "marks": GOOD, **fields})


def codes(*seen: tuple[SampleRow, int]) -> list[str]:
    guard = SampleGuard()
    for sample, fingerprint in seen:
        guard.see(sample, fingerprint)
    return [warning.code for warning in guard.warnings()]


@pytest.mark.parametrize(
    ("second", "fingerprint"),
    [
        (row("b"), 2),
        (row("b", cell="http/binary"), 1),  # the same picture in another cell
        (row("b", marks=LOOSE, warmup=True), 2),
        (row("b", error=INTERRUPTED, marks=[]), 2),
        (row("b", facts={"headers_off_ms": -2.8}, server_prompt_ms=97.5), 2),
        (row("b", facts={"headers_off_ms": 19.0}, server_prompt_ms=5.0), 2),
        (row("b", facts={"headers_off_ms": 200.0}, server_prompt_ms=1000.0), 2),
    ],
)
def test_good_samples_raise_no_warning(second: SampleRow, fingerprint: int) -> None:
    assert codes((row("a"), 1), (second, fingerprint)) == []


@pytest.mark.parametrize(
    ("second", "fingerprint", "code"),
    [
        (row("b"), 1, "duplicate-frames"),
        (row("b", cache_n=7), 2, "prompt-cache"),
        (row("b", facts={"usage_zero": 1.0}), 2, "usage-zero"),
        (row("b", marks=LOOSE), 2, "residual"),
        (row("b", facts={"frames_lost": 2.0}), 2, "lost-frames"),
        (row("b", facts={"headers_off_ms": -97.0}, server_prompt_ms=97.5), 2, "ingest-unsure"),
        (row("b", error="MessagesLost: 3", marks=[]), 2, "lost-messages"),
        (row("b", error="RequestFailed: x", marks=[]), 2, "failed-samples"),
        (row("b", error="RequestFailed: x", marks=[], facts={"stale_frames": 1.0}), 2, "stale-frames"),
    ],
)
def test_each_warning_has_its_code(second: SampleRow, fingerprint: int, code: str) -> None:
    assert codes((row("a"), 1), (second, fingerprint)) == [code]


@pytest.mark.parametrize(
    ("off_ms", "says"), [(97.0, "ingest is too short, inference too long"), (-97.0, "ingest is too long, inference")]
)
def test_headers_at_another_moment_are_told_with_the_half_that_is_too_long(off_ms: float, says: str) -> None:
    guard = SampleGuard()
    guard.see(row("a", facts={"headers_off_ms": off_ms}, server_prompt_ms=97.5), 1)
    (warning,) = guard.warnings()
    assert says in warning.message


def padded_ms(least: float, most: float) -> list[float]:
    """What a client sees of answers that are computed and then held back for 33 ms: a pile at its end."""
    random = np.random.default_rng(1)
    return list(np.maximum(1e3 / 30, random.uniform(least, most, 100)) + 0.4 + random.exponential(0.4, 100))


def computed_ms(mean: float, deviation: float) -> list[float]:
    """What a client sees of a policy that takes little more than 33 ms itself."""
    return list(np.random.default_rng(2).normal(mean, deviation, 100))


@pytest.mark.parametrize(
    ("waits_ms", "slept"),
    [
        ([33.5, 33.9, 34.1, 60.0], True),
        ([33.5] * 9 + [33.1] * 3, False),  # some came while it would have slept
        ([20.0, *[33.5] * 60], False),
        ([90.0, 33.5] + [80.0] * 60, False),
        ([34.0] * 60, True),  # as a policy that takes exactly this long would: the text says "may"
        (padded_ms(5, 30), True),
        (padded_ms(25, 45), True),
        (computed_ms(34.0, 0.25), False),
        (computed_ms(36.0, 0.9), False),
        ([*np.random.default_rng(3).lognormal(np.log(37), 0.03, 100)], False),
    ],
)
def test_a_server_that_sleeps_is_known_by_its_earliest_answers(waits_ms: list[float], slept: bool) -> None:
    guard = SampleGuard([CELL])
    for at, wait_ms in enumerate(waits_ms):
        guard.see(row(str(at), facts={"wait_ms": wait_ms}), at)
    assert [(each.code, each.advice) for each in guard.warnings()] == [("padded-answers", "wake it")] * slept


def test_hits_that_servers_count_during_the_run_are_a_warning() -> None:
    guard = SampleGuard()
    guard.see_hits({"vllm:mm_cache_hits_total": 4.0, "b": 2.0}, {"vllm:mm_cache_hits_total": 4.0, "b": 2.0})
    assert guard.warnings() == []
    guard.see_hits({"vllm:mm_cache_hits_total": 4.0}, {"vllm:mm_cache_hits_total": 9.0, "new": 0.0})
    (warning,) = guard.warnings()
    assert (warning.code, "vllm:mm_cache_hits_total: 5" in warning.message) == ("server-cache", True)


def test_a_warning_names_cells_and_the_way_out() -> None:
    guard = SampleGuard()
    for number in range(3):
        guard.see(row(str(number)), 1)
    (warning,) = guard.warnings()
    assert "ros/topic: 2" in warning.message
    assert "synthetic" in warning.advice


def test_what_to_do_against_loss_is_what_the_transport_of_the_cell_says() -> None:
    guard = SampleGuard([CELL])
    guard.see(row("a", facts={"frames_lost": 2.0}), 1)
    guard.see(row("b", error="MessagesLost: 3"), 2)
    assert [warning.advice for warning in guard.warnings()] == ["export A=1", "export A=1"]
    (dropped,) = Counters(receive_buffer_errors=4).warnings_since(Counters(receive_buffer_errors=0), "export A=1")
    assert dropped.advice == "export A=1"


@pytest.mark.parametrize(
    ("after", "code"),
    [
        (Counters(receive_buffer_errors=4), "udp-receive-buffer"),
        (Counters(receive_buffer_errors=0, throttles=1), "cpu-throttling"),
        (Counters(receive_buffer_errors=0, suspended_ns=10**9), "suspended"),
        (Counters(receive_buffer_errors=0, realtime_offset_ns=-(10**9)), "clock-jump"),
    ],
)
def test_counters_that_rise_are_warnings(after: Counters, code: str) -> None:
    before = Counters(receive_buffer_errors=0, throttles=0)
    assert [warning.code for warning in after.warnings_since(before)] == [code]


def series(correlation: float, n: int = 60, launches: int = 1) -> list[SampleRow]:
    """Return samples whose times remember the one before (AR(1))."""
    rng = np.random.default_rng(4)
    level, rows = 0.0, []
    for place in range(n):
        level = correlation * level + (1 - correlation**2) ** 0.5 * rng.standard_normal()
        end_ns = round(1e6 * 1.1**level)
        marks: list[Mark] = [("", 0), ("network", end_ns), ("inference", end_ns + 5), ("return", end_ns + 6)]
        rows.append(row(f"{place}", marks=marks, launch=place * launches // n))
    return rows


def test_neighbours_that_are_alike_are_a_warning_with_the_way_out() -> None:
    guard = SampleGuard()
    for place, sample in enumerate(series(0.95, 100)):
        guard.see(sample, place)
    (warning,) = guard.warnings()
    assert warning.code == "autocorrelation"
    assert re.search(r"ros/topic: 100 samples are worth \d+\b", warning.message)
    assert "--launches 5" in warning.advice


@pytest.mark.parametrize(("correlation", "n", "launches"), [(0.0, 60, 1), (0.3, 60, 1), (0.0, 10, 1), (0.9, 60, 3)])
def test_few_or_other_samples_or_several_launches_are_none(correlation: float, n: int, launches: int) -> None:
    assert codes(*((sample, place) for place, sample in enumerate(series(correlation, n, launches)))) == []


def test_failures_in_a_row_of_every_client_end_with_a_success_of_any() -> None:
    guard = SampleGuard()
    for number, (error, client) in enumerate([("x", 0), ("x", 1), ("", 2), ("x", 0), ("x", 0)]):
        guard.see(row(str(number), error=error), number, client=client)
    assert guard.in_a_row["ros/topic"] == {0: 2}
    assert guard.succeeded["ros/topic"] == 1
    assert guard.succeeded["loopback"] == 0
    assert guard.last_error == {"ros/topic": "x"}


def test_what_cannot_be_read_and_packets_lost_by_others_are_no_warning_about_a_run_without_dds() -> None:
    assert not [*Counters(None, None).warnings_since(Counters(3, 5))]
    now = Counters.read()
    assert not [*now.warnings_since(now)]
    assert now.receive_buffer_errors is not None
    assert Counters.read(watches_udp=False).receive_buffer_errors is None


@pytest.mark.parametrize(("closed", "expected"), [(12, ["reconnects"]), (7, ["reconnects"]), (6, []), (0, [])])
def test_a_server_that_closes_most_kept_connections_is_warned_of(closed: int, expected: list[str]) -> None:
    seen = [row(f"{n}", facts={"reconnects": 1.0} if n < closed else {}) for n in range(13)]
    warm_ups = [row(f"warm-up {n}", warmup=True, facts={"reconnects": 1.0}) for n in range(9)]
    assert codes(*((sample, n) for n, sample in enumerate([*seen, *warm_ups]))) == expected
