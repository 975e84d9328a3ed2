"""A measured run's fleets, one by one, without a server: looks, rows, processes, phases, and what is no measurement."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from s2a_bench.harness.plan import resolve
from s2a_bench.plugins.chunks.capacity import run as run_module
from s2a_bench.plugins.chunks.capacity.config import CapacityMeasured, CapacityPredicted
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, REQUESTS, ROBOTS
from s2a_bench.plugins.chunks.capacity.run import _Robots
from s2a_bench.plugins.chunks.capacity.search import Judge, Tried
from s2a_bench.plugins.chunks.modes import Ticks
from s2a_bench.testing import NullProgress

MS = 1_000_000
CONFIG = CapacityPredicted(predict="20", modes="sync", settle_s=0, control_hz=50, looks=4)
SEARCH = CONFIG.search
(LOAD,) = CONFIG.loads


def trace(late_ms: float = 0, *, stalled: int = 0, ticks: bool = True) -> RobotTrace:
    """Make 2 s of a robot: 100 ticks of 20 ms, some stall; a request of 40 ms each 100 ms, the last unanswered."""
    chunk = np.where(np.diff(np.arange(101) * stalled // 100), -1, 0)
    latency_ns = np.where(np.arange(20) == 19, -1, 40 * MS)
    late_ns = np.full(100 if ticks else 20, round(late_ms * MS))
    acted = Ticks(chunk, chunk, chunk, chunk < -1) if ticks else None
    return RobotTrace(0, 0, 2000 * MS, np.arange(20) * 100 * MS, latency_ns, acted, latency_ns, late_ns)


class Looks:
    """Robots that did the same in every look."""

    def __init__(self, one: RobotTrace) -> None:
        self.name, self.trace, self.looked, self.stopped = "c", one, 0, False
        self.session: Any = SimpleNamespace(cell=SimpleNamespace(name="c"), origin=SimpleNamespace(to_dict=dict))

    def looks(self, _number: int) -> Iterator[Any]:
        for self.looked in (1, 2, 3, 4):
            yield [self.trace], {}

    def stop(self) -> None:
        self.stopped = True


def fleet(robots: Looks, source: Any = "measured", number: int = 2, mode: str = "sync", **judge: Any) -> Any:
    """Return what is made of a fleet, and its rows by table."""
    rows: dict[str, list[Any]] = {table.name: [] for table in (FLEETS, ROBOTS, REQUESTS)}
    writer = SimpleNamespace(
        manifest={"provenance": {"cells": {"c": {}}}}, append=lambda table, found: rows[table.name].extend(found)
    )
    launch: Any = SimpleNamespace(writer=writer, progress=NullProgress())
    judges = Judge(SEARCH.limit, beyond=judge.get("beyond", False), settle_ns=0, confidence=0.95)
    load = LOAD if mode else replace(LOAD, mode=None, name="")
    nothing: Any = object()
    cell = run_module._Cell(load, SEARCH, judges, launch, nothing, robots.session, None, service=nothing)
    found = cell._fleet(robots, number, source)  # type: ignore[arg-type]
    assert robots.stopped
    return found, rows


@pytest.mark.parametrize(
    ("source", "late_ms", "mode", "clean"),
    [
        ("measured", 0.9, "sync", True),  # of a tick of 20 ms
        ("measured", 1.1, "sync", False),
        ("measured", 1.9, "", True),  # of a latency of 40 ms
        ("measured", 2.1, "", False),
        ("twin", 1.1, "sync", True),
    ],
)
def test_a_fleet_is_no_measurement_if_its_own_ticks_are_late_by_over_a_twentieth(
    source: str, late_ms: float, mode: str, clean: bool
) -> None:
    found, rows = fleet(Looks(trace(late_ms, ticks=bool(mode))), source, mode=mode)
    (row,) = rows[FLEETS.name]
    assert (found.clean, row.clean, row.late_p99_ns) == (clean, clean, round(late_ms * MS))


@pytest.mark.parametrize(
    ("source", "number", "stalled", "beyond", "looks"),
    [
        ("measured", 2, 50, False, 1),  # decided
        ("measured", 2, 1, False, 4),  # never
        ("measured", 1, 50, False, 1),
        ("measured", 1, 50, True, 4),  # the others are judged by it
        ("measured", 2, 50, True, 1),
        ("twin", 2, 1, False, 1),
    ],
)
def test_a_fleet_is_looked_at_until_it_is_decided(
    source: str, number: int, stalled: int, beyond: bool, looks: int
) -> None:
    robots = Looks(trace(stalled=stalled))
    _, rows = fleet(robots, source, number, beyond=beyond)
    assert robots.looked == rows[FLEETS.name][0].looks == looks


def test_every_request_and_every_robot_has_a_row() -> None:
    _, rows = fleet(Looks(trace(stalled=50)), number=2)
    (robot,), requests = rows[ROBOTS.name], rows[REQUESTS.name]
    assert (robot.stalled, robot.robot, robot.robots) == (0.5, 0, 2)
    assert [each.latency_ns for each in requests] == [40 * MS] * 19 + [None]
    assert [each.intended_ns for each in requests] == [place * 100 * MS for place in range(20)]


@pytest.mark.parametrize("within", [True, False])
def test_a_fleet_is_withdrawn_for_a_twin_that_exceeds_the_limit_and_not_for_one_whose_ticks_are_late(
    monkeypatch: pytest.MonkeyPatch, within: bool
) -> None:
    def found(_cell: Any, _robots: Any, number: int, source: str) -> Tried:
        twin = source == "twin"
        return Tried(number, "below", within=number < 4 or (twin and within), clean=not twin)

    monkeypatch.setattr(run_module._Cell, "_fleet", found)
    monkeypatch.setattr(run_module._Cell, "_conclude", lambda _: None)
    search = CONFIG.but(robots="1..4").search
    nothing: Any = SimpleNamespace()
    judge = Judge(search.limit, beyond=False, settle_ns=0, confidence=0.95)
    cell = run_module._Cell(LOAD, search, judge, nothing, lambda *_, **__: nullcontext(), nothing, nothing)  # type: ignore[arg-type, return-value]
    cell.run()
    assert {number: each.clean for number, each in cell.tried.items()} == {1: True, 2: True, 3: True, 4: within}


def robots_of(monkeypatch: pytest.MonkeyPatch, *, twin: bool = False, **options: Any) -> _Robots:
    """Return robots whose fleets are `(kind, plan)`."""
    for kind in ("Fleet", "FleetProcess"):
        monkeypatch.setattr(
            run_module, kind, lambda plan, kind=kind: SimpleNamespace(kind=kind, plan=plan, close=lambda: None)
        )
    config = CapacityMeasured(**options)
    plan = resolve(config.robots_requests, print)
    launch: Any = SimpleNamespace(plan=plan, wiring=lambda _: SimpleNamespace(to_json=dict))
    session: Any = SimpleNamespace(cell=plan.cells[0], origin=None)
    return _Robots(config.loads[0], config.search, config.processes, None, launch, 0, session, twin=twin)


@pytest.mark.parametrize(
    ("transport", "processes", "twin", "kinds", "own"),
    [
        ("loopback", 1, False, ["Fleet"], False),
        ("loopback", 2, False, ["Fleet"], False),  # the engine is in this process
        ("loopback", 2, True, ["FleetProcess"] * 2, True),  # an instant one in each
        ("http/binary", 1, True, ["Fleet"], False),
        ("http/binary", 2, False, ["FleetProcess"] * 2, False),
        ("http/binary", 2, True, ["FleetProcess"] * 2, False),  # all at the server of the run
    ],
)
def test_robots_are_in_as_many_processes_as_their_server_lets_them(
    monkeypatch: pytest.MonkeyPatch, transport: str, processes: int, twin: bool, kinds: list[str], own: bool
) -> None:
    options = {"requests": {"transports": transport}, "processes": processes, "modes": "sync"}
    fleets = robots_of(monkeypatch, twin=twin, **options)._fleets
    assert [each.kind for each in fleets] == kinds
    assert [each.plan.own is not None for each in fleets] == [own] * len(kinds)


@pytest.mark.parametrize(
    ("options", "cycle_ms"),
    [
        ({"modes": "sync"}, 16 * 20),
        ({"modes": "queue?trigger=8", "control_hz": 100}, 16 * 10),
        ({"plan_every_s": 2, "limit": "stalled=50%"}, 2000),
        ({"closed_loop": True, "think_s": 0.5}, 500),
    ],
)
def test_robots_start_at_random_moments_of_a_cycle(
    monkeypatch: pytest.MonkeyPatch, options: Any, cycle_ms: float
) -> None:
    robots, cycle_ns = robots_of(monkeypatch, requests={"transports": "loopback"}, **options), cycle_ms * MS
    phases_ns = np.array([*robots._phases(2000).values()])
    assert 0 <= phases_ns.min() < 0.01 * cycle_ns
    assert 0.99 * cycle_ns < phases_ns.max() <= cycle_ns
    assert phases_ns.mean() == pytest.approx(cycle_ns / 2, rel=0.05)
