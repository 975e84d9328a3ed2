"""The load generator: intended times, late and missing answers, and a fleet against a server that is really there."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import count
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import s2a_bench as s2a
from s2a_bench.clock import VirtualClock
from s2a_bench.errors import ServerDied
from s2a_bench.harness.config import RequestsConfig
from s2a_bench.harness.plan import resolve
from s2a_bench.harness.session import Measured, Place, RequestContext, Session
from s2a_bench.plugins.chunks.capacity import generator
from s2a_bench.plugins.chunks.capacity import run as run_module
from s2a_bench.plugins.chunks.capacity.config import RobotLoad
from s2a_bench.plugins.chunks.capacity.generator import Fleet, FleetPlan, PlainRobot
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, KNEES, REQUESTS, ROBOTS
from s2a_bench.plugins.chunks.capacity.run import twin
from s2a_bench.plugins.chunks.modes import ControlSetting
from s2a_bench.plugins.chunks.options import LoopRequests
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.types import Token
from tests.cli.test_provenance import serving

MS = 1_000_000
PLAN = resolve(RequestsConfig(transports="loopback"), print)
REQUEST = PLAN.request


class Over:
    """An event whose waits move a virtual clock."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock, self._set = clock, False

    def set(self) -> None:
        self._set = True

    def wait(self, timeout_s: float) -> bool:
        self._clock.sleep_until_ns(self._clock.now_ns() + round(timeout_s * 1e9))
        return self._set


def robot_of(
    monkeypatch: pytest.MonkeyPatch, answers: list[list[int] | str], every_ns: int = 0, think_ns: int = 0
) -> RobotTrace:
    """Return what a robot does until 10 s, from 1 s on, whose answers have pieces after some ms, or fail."""
    clock = VirtualClock()
    monkeypatch.setattr(generator, "now_ns", clock.now_ns)

    def measure(_place: Place, context: RequestContext) -> Measured:
        pieces = answers.pop(0)
        started_ns = clock.now_ns()
        for index, after_ms in enumerate([] if isinstance(pieces, str) else pieces):
            clock.sleep_until_ns(started_ns + after_ms * MS)
            cast("Callable[[Any, int], None]", context.on_piece)(Token(index, "word"), clock.now_ns())
        if not answers:
            robot.end()
        error = pieces if isinstance(pieces, str) else ""
        sample: Any = SimpleNamespace(error=error)
        return Measured(sample, [], 0, fatal=ServerDied("gone") if error == "fatal" else None)

    session: Any = SimpleNamespace(measure=measure, request=REQUEST)
    load = RobotLoad(ControlSetting(20 * MS, 16), every_ns=every_ns, think_ns=think_ns)
    robot = PlainRobot(load, cast("Session", session), count(), 1000 * MS, SimpleQueue())
    robot.over = cast("Any", Over(clock))
    robot.work()
    return robot.trace(0, 10_000 * MS)


def test_closed_loop_requests_again_a_while_after_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    trace = robot_of(monkeypatch, [[100, 300], [50, 60], [1, 2]], think_ns=500 * MS)
    assert (trace.request_ns // MS).tolist() == [1000, 1800, 2360]
    assert (trace.arrival_ns // MS).tolist() == [300, 60, 2]
    assert cast("Any", trace.first_ns // MS).tolist() == [100, 50, 1]
    assert trace.plan_stalled is None
    assert cast("Any", trace.late_ns).max() == 0


def test_latency_of_a_plan_counts_from_when_it_was_due(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second waits for the first, and those after the third are due and never requested."""
    trace = robot_of(monkeypatch, [[2000, 5000], [10, 1000], [10, 1000]], every_ns=2000 * MS)
    assert (trace.request_ns // MS).tolist() == [1000, 3000, 5000, 7000]
    assert (trace.arrival_ns // MS).tolist() == [5000, 4000, 3000, -1]
    assert cast("Any", trace.first_ns // MS).tolist() == [2000, 3010, 2010, -1]


@pytest.mark.parametrize(
    ("pieces_ms", "stalls"),
    [
        ([1900], False),
        ([2100], True),
        ([100, 2900], False),  # the second piece is due 1 s after the first: S0 1.9 s
        ([100, 3100], True),
        ([2100, 2200], True),  # the first piece is late, and the second in time for it
        ("RequestFailed: broken", True),
    ],
)
def test_a_plan_stalls_if_its_safe_start_is_after_the_next_is_due(
    monkeypatch: pytest.MonkeyPatch, pieces_ms: Any, stalls: bool
) -> None:
    trace = robot_of(monkeypatch, [pieces_ms], every_ns=2000 * MS)
    assert bool(cast("Any", trace.plan_stalled)[0]) == stalls


def test_what_breaks_in_a_robot_is_raised_where_its_trace_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(IndexError, match="pop from empty list"):
        robot_of(monkeypatch, [])


def test_a_robot_goes_on_after_an_answer_that_breaks_and_ends_with_its_server(monkeypatch: pytest.MonkeyPatch) -> None:
    trace = robot_of(monkeypatch, ["broken", [10], "fatal", [10]], think_ns=100 * MS)
    assert [each >= 0 for each in trace.arrival_ns] == [False, True, False]


def test_a_fleet_acts_on_its_own_clock_and_reports_on_that_of_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = VirtualClock(10**15)
    monkeypatch.setattr(generator, "now_ns", clock.now_ns)
    load = RobotLoad(ControlSetting(20 * MS, 16), every_ns=10**15)
    fleet = Fleet(FleetPlan("c", {}, PLAN, load))
    fleet._sessions = {robot: (cast("Session", None), count()) for robot in range(2)}
    fleet.start({0: 0, 1: 7 * MS}, 100 * MS)
    clock.sleep_until_ns(10**15 + 300 * MS)
    traces = fleet.traces(5 * MS)
    assert [(each.start_ns // MS, each.end_ns // MS) for each in traces] == [(5, 205), (12, 205)]
    fleet.stop()


@pytest.mark.parametrize(
    ("written", "options", "same"),
    [
        ("websocket/openpi", {"websocket": {"url": "ws://127.0.0.1:9"}}, "websocket/openpi"),
        ("http/binary", {}, "http/binary"),
        ("http/llama-server", {}, "loopback"),
    ],
)
def test_the_twin_is_an_instant_server_of_ours_on_the_same_wire(written: str, options: Any, same: str) -> None:
    cell = LoopRequests(transports=written, options=options).pipelines[0]
    found = twin(cell)
    assert found.name == f"{cell.name}, instant"
    assert "/".join(filter(None, (found.transport.name, found.variant))) == same
    assert not found.black_box
    assert dict(found.engine)["name"] == "echo"


def small(output: Any, **options: Any) -> StoredRun:
    """Return a run of short fleets that send small pictures."""
    settings = {"size": "64x48", "seconds": 1, "settle": 0.5, "looks": 1, **options}
    return read_run(s2a.capacity(output=output, **settings).path)


@pytest.fixture
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the generator be late: a machine under load says nothing of what is tested."""
    monkeypatch.setattr(run_module, "LATEST", math.inf)


@pytest.mark.slow
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("processes", [1, 2])
def test_a_server_of_another_kind_is_checked_against_a_call_within_each_process(tmp_path: Any, processes: int) -> None:
    options = {"dialect": "openai", "max_tokens": 4, "plan_every": 0.4, "limit": "stalled=50%", "seconds": 1.5}
    with serving("http", "--engine", "echo", "--latency", "20", "--port", "0") as line:
        run = small(tmp_path, url=line.split()[2].rstrip(";"), robots="3", processes=processes, **options)
    fleets = run.table(FLEETS).set_index(["source", "robots"])
    assert {*fleets.index} == {(source, robots) for source in ("measured", "predicted") for robots in (1, 3)} | {
        ("twin", 3)
    }
    latency_ns = fleets["latency_p50_ns"]
    assert latency_ns["twin", 3] < 20 * MS <= latency_ns["measured", 1]


@pytest.mark.slow
@pytest.mark.parametrize("processes", ["1", "2"])
def test_ctrl_c_ends_the_search_in_a_line_and_what_was_measured_stays(tmp_path: Any, processes: str) -> None:
    command = [sys.executable, "-m", "s2a_bench", "capacity", "--transport", "http/binary", "--size", "64x48"]
    command += ["--latency", "400", "--modes", "sync", "--robots", "1,8", "--limit", "", "--processes", processes]
    command += ["--seconds", "2", "--settle", "0", "--looks", "1", "--output", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    next(line for line in cast("Any", process.stderr) if "8 robots" in line)
    time.sleep(1)  # answers are under way
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in err
    (folder,) = tmp_path.iterdir()
    assert read_run(folder).table(FLEETS)["robots"].tolist() == [1]


def test_no_mode_has_the_names_or_the_pictures_of_another(tmp_path: Any) -> None:
    run = small(tmp_path, transports="loopback", modes="sync,queue", limit="", robots="2", seconds=0.3, settle=0)
    assert run.samples["request_id"].is_unique
    assert "duplicate-frames" not in {warning["code"] for warning in run.manifest["warnings"]}


def test_clients_without_a_clock_need_no_instant_server(tmp_path: Any) -> None:
    run = small(tmp_path, transports="http/binary", latency=30, closed_loop=True, robots="3")
    assert {*run.table(FLEETS)["source"]} == {"measured", "predicted"}
    assert [*run.manifest["servers"]] == ["http"]


@pytest.mark.slow
@pytest.mark.usefixtures("unhurried")
def test_a_robot_that_leaves_no_room_for_the_limit_is_no_matter_of_the_generator(tmp_path: Any) -> None:
    run = small(
        tmp_path, transports="http/binary", latency=700, modes="sync", robots="1..4", limit="stalled=50%", seconds=3
    )
    assert run.table(KNEES)["high"].tolist() == [0, 0], "measured, predicted"
    assert "generator-late" not in {warning["code"] for warning in run.manifest["warnings"]}


@pytest.mark.slow
def test_a_fleet_that_its_server_refuses_in_part_is_measured(tmp_path: Any) -> None:
    options = ("--answer", "actions", "--latency", "100", "--max-waiting", "1", "--port", "0")
    with serving("websocket", "--engine", "echo", *options) as line:
        url = line.split("at ")[1].split(",")[0]
        run = small(tmp_path, url=url, modes="sync", limit="", robots="6", seconds=2.5)
    fleets = run.table(FLEETS).set_index(["source", "robots"])
    assert (run.samples["error"] != "").sum() > 5
    assert fleets["requests_per_s"]["measured", 6] > 5
    assert fleets["stalled_worst"]["measured", 6] > fleets["stalled"]["measured", 1] + 0.2


def test_robots_act_at_their_clock_and_are_served_in_turn(tmp_path: Any) -> None:
    """Those of two processes; of one are the other tests' robots."""
    run = small(tmp_path, transports="http/binary", latency=30, modes="queue?trigger=8", robots="3", processes=2)
    fleets, robots, requests = (run.table(each) for each in (FLEETS, ROBOTS, REQUESTS))
    measured = fleets[fleets["source"] == "measured"]
    assert measured["robots"].tolist() == [1, 3]
    together = robots[(robots["robots"] == 3) & (robots["source"] == "measured")]
    assert sorted(together["robot"]) == [0, 1, 2]
    mine = requests[(requests["robots"] == 3) & (requests["source"] == "measured")]
    answered = mine["latency_ns"].dropna()
    assert set(mine["robot"]) == {0, 1, 2}
    assert (answered >= 30 * MS).all()
    assert (mine["intended_ns"] % (20 * MS) == 0).all()  # a tick
    assert (mine["settling"] == (mine["intended_ns"] < 500 * MS)).all()
    assert np.isfinite(measured["generator_cpu"]).all()
    assert {"measured", "predicted"} <= set(fleets["source"])
