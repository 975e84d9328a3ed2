"""Rows of a watched robot: the parts of a cycle add up, and dry times are a lower bound."""

from __future__ import annotations

from typing import Any

import pytest

from s2a_bench.plugins.watch.rows import STAGES, ExchangeRow, SeenCycles, sample_of, tokens_of
from s2a_bench.store.requests import samples_table
from s2a_bench.transport.tap import Seen

MS = 1_000_000
PARTS = ("upload_ns", "server_ns", "inference_ns", "download_ns")


def seen(at_ms: float, *, what: str = "a", **changes: Any) -> Seen:
    """Return an exchange: 1 ms up, 10 ms at the server, 2 ms down."""
    request_ns = round(at_ms * MS)
    times = {"sent_ns": request_ns + MS, "answer_ns": request_ns + 11 * MS, "end_ns": request_ns + 13 * MS}
    return Seen(what, request_ns, **{**times, "up_bytes": 5, "down_bytes": 3, **changes})


def rows(cycles: SeenCycles, *exchanges: Seen, client: int = 0) -> list[ExchangeRow]:
    return [cycles.row(client, each) for each in exchanges]


def test_the_parts_of_a_cycle_add_up_to_the_period() -> None:
    first, second = rows(SeenCycles(), seen(100, infer_ms=4.0), seen(150))
    assert first.think_ns is first.period_ns is None
    parts = [getattr(first, part) for part in PARTS]
    assert parts == [MS, 6 * MS, 4 * MS, 2 * MS]
    assert second.period_ns == 50 * MS == sum(parts) + (second.think_ns or 0)
    assert (second.inference_ns, second.age_ns) == (None, 13 * MS)


@pytest.mark.parametrize("infer_ms", [-1.0, 1e300, 14.0])
def test_what_a_server_says_of_another_time_is_left_out(infer_ms: float) -> None:
    (row,) = rows(SeenCycles(), seen(0.001, infer_ms=infer_ms))
    assert (row.server_ns, row.inference_ns) == (10 * MS, None)


def test_a_server_may_have_begun_before_the_tap_knew_that_it_had_sent_all() -> None:
    (row,) = rows(SeenCycles(), seen(1, infer_ms=10.1))
    assert (row.server_ns, row.inference_ns) == (0, 10 * MS)
    (row,) = rows(SeenCycles(), seen(1, infer_ms=10.1, pieces_ns=[12 * MS, 13 * MS]))
    assert (row.server_ns, row.inference_ns) == (10 * MS, None)


def test_a_stream_is_answered_by_its_first_piece() -> None:
    (row,) = rows(SeenCycles(), seen(1, pieces_ns=[12 * MS + 1, 13 * MS, 14 * MS]))
    assert (row.server_ns, row.age_ns, row.pieces) == (10 * MS + 1, 11 * MS + 1, 3)


def test_clients_and_kinds_have_cycles_of_their_own() -> None:
    cycles = SeenCycles()
    rows(cycles, seen(1), seen(5, what="b"))
    (again,) = rows(cycles, seen(30), client=1)
    assert again.period_ns is None
    (again,) = rows(cycles, seen(31))
    assert again.period_ns == 30 * MS


def test_a_failure_has_no_times_and_ends_the_cycle() -> None:
    cycles = SeenCycles()
    broken = Seen("a", 20 * MS, sent_ns=21 * MS, error="the connection ended before the answer")
    _, failed, after = rows(cycles, seen(1), broken, seen(40))
    assert [getattr(failed, part) for part in PARTS] == [None] * 4
    assert failed.error
    assert (after.think_ns, after.period_ns) == (None, 20 * MS)
    (cut,) = rows(cycles, Seen("a", 60 * MS))
    assert cut.error == "no answer"


@pytest.mark.parametrize(("period_ms", "dry_ms"), [(200, 40), (160, 0), (150, 0)])
def test_a_robot_of_50_hz_and_8_actions_lasts_160_ms(period_ms: int, dry_ms: int) -> None:
    cycles = SeenCycles(tick_ns=20 * MS)
    first, *others = rows(cycles, *(seen(1 + period_ms * cycle, chunk=(8, 7)) for cycle in range(50)))
    assert first.dry_ns is None
    assert {row.dry_ns for row in others} == {dry_ms * MS}
    assert (first.horizon, first.dim) == (8, 7)


def test_actions_that_are_left_are_counted_for_the_robot() -> None:
    cycles = SeenCycles(tick_ns=20 * MS)
    _, early, late = rows(cycles, *(seen(at_ms, chunk=(8, 7)) for at_ms in (1, 101, 321)))
    assert (early.dry_ns, late.dry_ns) == (0, 0)  # 320 ms of actions for 320 ms, though one gap was 220
    (empty,) = rows(cycles, seen(621, chunk=(8, 7)))
    assert empty.dry_ns == (620 - 480) * MS


@pytest.mark.parametrize("between", [{"chunk": None}, {"chunk": (8, 7), "error": "HTTP 500"}])
def test_after_an_answer_that_is_not_known_nothing_is_dry(between: dict[str, Any]) -> None:
    cycles = SeenCycles(tick_ns=20 * MS)
    _, odd, after, last = rows(
        cycles, seen(1, chunk=(8, 7)), seen(201, **between), seen(401, chunk=(8, 7)), seen(601, chunk=(8, 7))
    )
    assert [row.dry_ns for row in (odd, after, last)] == [None, None, 40 * MS]


def test_a_row_is_a_request_for_other_commands() -> None:
    exchange = seen(1, infer_ms=4.0)
    (row,) = rows(SeenCycles(), exchange)
    sample = sample_of(row, exchange, 7, "websocket")
    table = samples_table(STAGES)
    values = dict(zip(table.columns, table.values(sample), strict=True))
    assert (values["e2e_ns"], values["residual_ns"], values["inference_ns"]) == (13 * MS, 0, 4 * MS)
    assert not list(tokens_of(row, exchange, 7))


def test_a_stream_is_a_request_with_tokens() -> None:
    exchange = seen(1, pieces_ns=[12 * MS, 14 * MS])
    (row,) = rows(SeenCycles(), exchange)
    table = samples_table(STAGES)
    values = dict(zip(table.columns, table.values(sample_of(row, exchange, 7, "http")), strict=True))
    assert (values["e2e_ns"], values["download_ns"]) == (11 * MS, None)
    assert [token.client_ns for token in tokens_of(row, exchange, 7)] == [12 * MS, 14 * MS]
