"""Chunks live: what the loop did is what virtual time says of the same latencies, over transports that labs use."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from s2a_bench.act import ROBOTS, ActionKind, ActionRobot
from s2a_bench.clock import VirtualClock
from s2a_bench.errors import EngineError, RequestFailed, RobotError, S2AError, UsageError
from s2a_bench.harness.session import PLAIN, Measured, Place, RequestContext, Session
from s2a_bench.inference import EngineConfig, chunk, echo
from s2a_bench.library import Run
from s2a_bench.plugins.chunks import acting
from s2a_bench.plugins.chunks.chunks.config import ChunksLive, ChunksVirtual
from s2a_bench.plugins.chunks.chunks.live import run_live
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS
from s2a_bench.plugins.chunks.chunks.view import show
from s2a_bench.plugins.chunks.control import ControlLoop
from s2a_bench.plugins.chunks.modes.append import QueueStepper, Sync
from s2a_bench.plugins.chunks.requester import ChunkRequester, Job
from s2a_bench.store.run import read_run
from s2a_bench.testing import NullProgress
from s2a_bench.types import Action, Request, Token, Vector
from tests.servers.policy_websocket import policy_server

TRIES = 5


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    """Act in virtual time: requests are served on the loop's thread, and last as long as the engine has slept."""
    slept, loop = VirtualClock(), VirtualClock()

    def requester(*given: Any) -> ChunkRequester:
        made = ChunkRequester(*given)
        arrived = made.on_actions

        def serve(job: Job | None) -> None:
            if job is None or made.over.is_set():
                return
            before_ns = loop.now_ns() - slept.now_ns()
            made.on_actions = lambda request, actions, _: arrived(request, actions, before_ns + slept.now_ns())
            try:
                made._ask(made.sessions[0], job)
            except S2AError as error:
                made.failure = error

        made.jobs = SimpleNamespace(put=serve, get=lambda: None)  # type: ignore[assignment]
        return made

    monkeypatch.setattr(acting, "ChunkRequester", requester)
    monkeypatch.setattr(acting, "ControlLoop", lambda robots: ControlLoop(robots, loop))
    monkeypatch.setattr(acting, "KEEP_S", 0.001)
    monkeypatch.setattr(echo, "SystemClock", lambda: slept)
    return slept


virtually = pytest.mark.usefixtures("slept")


def act(tmp_path: Path, *, transport: str = "loopback", warmup: int = 1, **options: object) -> pd.DataFrame:
    """Act for a moment and return a row a mode."""
    requests = {"transports": transport, "engine": {"name": "echo"}, "size": "64x48", "warmup": warmup}
    config = ChunksLive(**{"seconds": 1.5, "requests": requests, **options})
    tmp_path.mkdir(exist_ok=True)
    folder = run_live(config, tmp_path, NullProgress())
    return pd.read_csv(folder / "chunks.csv")


def folder_of(tmp_path: Path) -> Path:
    """Return the one run folder."""
    return next(path for path in tmp_path.iterdir() if path.is_dir())


@virtually
@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_every_mode_acts_as_computed(tmp_path: Path, rounding: str) -> None:
    modes = "sync,queue?trigger=4,replace?execute=5,aggregate?trigger=4,streamed?trigger=3"
    rows = act(tmp_path, modes=modes, rounding=rounding, latency="lognormal:mean_ms=50,cv=.5")
    folder = folder_of(tmp_path)
    assert len(rows) == 5
    assert (rows["agreement"] == 1).all()
    assert (rows["latency_s"] > 0).all()
    assert rows.loc[rows["mode"].str.startswith("sync"), "jump_max"].item() == 0
    ticks = pd.read_csv(folder / "chunk_ticks.csv")
    assert (ticks["late_ns"] >= 0).all()
    first = ticks.dropna(subset="chunk").groupby("cell")["tick"].min()
    length = ticks.groupby("cell")["tick"].max() + 1 - first
    pd.testing.assert_series_equal(length, rows.set_index("cell")["ticks"].sort_index(), check_names=False)


@virtually
@pytest.mark.parametrize(("mode", "rules"), [("queue?trigger=4", ""), ("queue", "maximum")])
def test_a_loop_with_another_trigger_than_its_mode_does_not_agree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, rules: str
) -> None:
    asks = QueueStepper.ask

    def asks_early(stepper: QueueStepper, tick: int) -> bool:
        trigger, stepper.trigger = stepper.trigger, 2 * stepper.trigger + 1
        try:
            return asks(stepper, tick)
        finally:
            stepper.trigger = trigger

    monkeypatch.setattr(QueueStepper, "ask", asks_early)
    rows = act(tmp_path, modes=mode, rules=rules, latency="50")
    assert (rows["agreement"] < 0.5).all()


@virtually
def test_requests_are_kept_as_samples_with_their_marks_and_ids(tmp_path: Path) -> None:
    rows = act(tmp_path, modes="replace?execute=8")
    run = read_run(folder_of(tmp_path))
    samples, requests = run.samples, pd.read_csv(run.path / "chunk_requests.csv")
    assert samples["warmup"].sum() == 1
    assert len(samples) - 1 >= rows["requests"].item()
    assert set(requests["request_id"]) <= set(samples["request_id"])
    assert set(rows["cell"]) <= set(run.origins.cells)


def test_several_requests_are_under_way_over_clients_of_their_own(tmp_path: Path) -> None:
    act(tmp_path, modes="replace?execute=2&under_way=many", seconds=0.5)
    assert read_run(folder_of(tmp_path)).samples["warmup"].sum() == 4  # of each client


@virtually
def test_a_live_run_is_shown_and_its_latencies_are_a_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Sync, "arrays", lambda *_: None)
    act(tmp_path, modes="queue?trigger=3,sync", shown_ticks=20)
    folder = folder_of(tmp_path)
    shown = show(read_run(folder))
    assert "loop" in shown.tables
    assert {"lanes", "reactions"} <= set(shown.figures)
    assert [panel.end_s for panel in shown.lanes.panels] == pytest.approx([20 * 0.02])
    assert not any("EMULATED" in str(note) for name in shown.main for note in shown.tables[name].notes)
    cell = json.loads(json.dumps(shown.json()))["cells"][0]
    assert cell["emulated"] is False
    assert {"agreement", "jitter_s_p99", "blocked_s_max", "late_ticks", "bytes_up_per_s"} <= set(cell)
    assert "that the modes' arrays give for the measured delays" in " ".join(shown.sentences)
    assert "not checked, as arrays do not cover its arrivals: sync;" in " ".join(shown.sentences)
    assert Run(folder).table("loop").shape[0] == 2
    again = ChunksVirtual(latency=f"{folder}#loopback", modes="queue?trigger=3", rules="")
    assert again.sources[0].recorded_ns is not None


@virtually
def test_delays_of_a_live_run_are_exported(tmp_path: Path) -> None:
    act(tmp_path, modes="queue", export_delays=tmp_path / "delays.csv")
    delays = pd.read_csv(tmp_path / "delays.csv")
    assert len(delays) >= 2
    assert (delays["received_ns"] > delays["observation_ns"]).all()
    assert (delays["rounding"] == "floor").all()


@virtually
def test_rules_choose_triggers_as_they_go(tmp_path: Path) -> None:
    options = {"rules": "calibrated,tracked,maximum,mean", "epsilon": 0.05, "latency": "lognormal:mean_ms=50,cv=.5"}
    rows = act(tmp_path, modes="queue,sync", warmup=19, seconds=2.5, **options)
    assert rows["rule"].value_counts().to_dict() == {"given": 2, "calibrated": 1, "tracked": 1, "maximum": 1, "mean": 1}
    trigger = rows.set_index("rule")["trigger"]
    assert 0 < trigger["mean"] < trigger["maximum"]
    assert trigger["calibrated"] > trigger["mean"]
    shown = show(read_run(folder_of(tmp_path)))
    order = [("queue", "given"), ("sync", "given"), ("queue", "calibrated")]
    assert [row[:2] for row in shown.tables["chunks"].rows][:3] == order


def test_a_calibrated_trigger_covers_the_way_from_the_tick_to_the_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slept: VirtualClock
) -> None:
    measure = Session.measure

    def starts_late(session: Session, place: Place, context: RequestContext = PLAIN) -> Measured:
        slept.sleep_until_ns(slept.now_ns() + 30_000_000)
        return measure(session, place, context)

    monkeypatch.setattr(Session, "measure", starts_late)
    rows = act(tmp_path, modes="queue", rules="calibrated", epsilon=0.05, latency="10", warmup=19)
    assert rows.set_index("rule").loc["calibrated", "trigger"] >= 2  # of 40 ms at 50 Hz
    assert read_run(folder_of(tmp_path)).samples["warmup"].sum() == 19


@virtually
def test_delays_that_changed_since_the_warm_up_are_named(tmp_path: Path) -> None:
    file = tmp_path / "delays.csv"
    file.write_text("latency_ms\n" + "30\n50\n30\n30\n" * 5 + "90\n110\n90\n90\n" * 100)
    options = {"rules": "calibrated,tracked", "epsilon": 0.05, "latency": str(file), "horizon": 5}
    act(tmp_path, modes="queue?trigger=1", warmup=20, seconds=2, **options)
    run = read_run(folder_of(tmp_path))
    changed = [each["message"] for each in run.manifest["warnings"] if each["code"] == "delays-changed"]
    assert len(changed) == 2
    assert all("delays changed since the calibration" in message for message in changed)
    notes = " ".join(show(run).tables["chunks"].notes)
    assert "lets at most" not in notes
    assert "No promise about stalls" in notes


@virtually
def test_a_slow_server_slows_actions_down(tmp_path: Path) -> None:
    options = {"rules": "calibrated", "epsilon": 0.05, "latency": "150", "slowest": 4.0, "horizon": 4}
    rows = act(tmp_path, modes="queue", warmup=19, seconds=4, **options).set_index("rule")
    assert rows.loc["given", "p_stall_cycle"] == 1
    assert rows.loc["calibrated", "slower"] == 150 / 60
    assert rows.loc["calibrated", "delta_t_s"] == pytest.approx(0.02 * rows.loc["calibrated", "slower"], rel=1e-3)
    assert rows.loc["calibrated", "stall_share"] < rows.loc["given", "stall_share"]


moved: list[float] = []


@dataclass(frozen=True)
class Arm(ActionKind):
    """Stand in for a robot that knows where it is."""

    def open_actions(self, dims: int, period_ns: int) -> ActionRobot:  # noqa: ARG002 - at any rate
        return Joints(dims)


class Joints(ActionRobot):
    def __init__(self, dims: int) -> None:
        self._at = np.zeros(dims, np.float32)

    def send(self, action: "Vector | None", at_ns: int) -> None:  # noqa: ARG002 - at any time
        self._at = self._at if action is None else action.copy()

    def state(self) -> tuple[float, ...]:
        return tuple(self._at.tolist())

    def describe(self) -> dict[str, str]:
        return {"robot": "arm"}

    def close(self) -> None: ...


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> str:
    """Offer the robot `arm`, as a package does."""
    point = EntryPoint("arm", f"{__name__}:Arm", ROBOTS.group)
    monkeypatch.setitem(vars(ROBOTS), "_offered", {"arm": point})
    return "arm"


def move(action: Vector) -> None:
    """Stand in for somebody's robot."""
    moved.append(float(action[0]))


def drop(action: Vector) -> None:
    """Stand in for a robot that breaks."""
    raise ValueError(f"no grip on {action.size}")


@virtually
def test_a_robot_moves_and_the_policy_is_told_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arm: str
) -> None:
    states: list[tuple[float, ...]] = []

    def chunk_of(config: EngineConfig, request: Request) -> Iterator[Action]:
        states.append(request.state)
        return chunk(config, request)

    monkeypatch.setattr("s2a_bench.inference.echo.chunk", chunk_of)
    rows = act(tmp_path, modes="replace?execute=8", robot=arm)
    assert rows["jump_max"].item() == 0  # echo's chunks are one trajectory
    assert {len(state) for state in states[2:]} == {7}
    assert len(set(states[2:])) > 1


@virtually
def test_a_function_is_called_with_every_action(tmp_path: Path) -> None:
    moved.clear()
    rows = act(tmp_path, modes="queue?trigger=4", robot=f"call?function={__name__}:move")
    assert len(moved) >= rows["ticks"].item() - rows["stall_ticks"].item()
    assert read_run(folder_of(tmp_path)).manifest["robot"]["function"].endswith(":move")


def test_a_robot_that_breaks_ends_the_run_with_one_line(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="drop: ValueError: no grip on 7"):
        act(tmp_path, modes="sync", robot=f"call?function={__name__}:drop")
    assert read_run(folder_of(tmp_path)).manifest["state"] == "failed"


def test_another_state_than_the_robot_has_is_refused(tmp_path: Path, arm: str) -> None:
    with pytest.raises(UsageError, match="`state`: `robot` arm has 7 numbers, not 3"):
        act(tmp_path, modes="sync", robot=arm, requests={"transports": "loopback", "state": 3})


@pytest.mark.parametrize("transport", ["websocket/openpi", "ros/topic"])
def test_over_what_labs_use(tmp_path: Path, transport: str) -> None:
    """An answer whose thread loses the core between its time stamp and its delivery is a tick late; it is tried again.

    Else the loop does what virtual time says.
    """
    for attempt in range(TRIES):
        rows = act(tmp_path / str(attempt), transport=transport, modes="queue?trigger=4,replace?execute=8", seconds=1)
        if (rows["agreement"] >= 0.99).all():
            break
    assert (rows["agreement"] >= 0.99).all()
    assert (rows[["bytes_up_per_s", "blocked_s_max"]] > 0).all().all()
    assert (rows["jitter_s_max"] >= rows["jitter_s_p50"]).all()


def recording(tmp_path: Path, *latency_ms: float) -> str:
    """Write latencies, which are played in their order."""
    path = tmp_path / "latencies.csv"
    path.write_text("latency_ms\n" + "\n".join(map(str, latency_ms)) + "\n")
    return str(path)


@virtually
def test_an_answer_that_has_not_come_by_the_end_counts_as_a_stall_to_the_end(tmp_path: Path) -> None:
    latency = recording(tmp_path, 10, 10, 10, 3500)  # the first is the warm-up's
    row = act(tmp_path / "runs", modes="queue", latency=latency, seconds=2.5).iloc[0]
    first_tick = round(row["first_action_s"] * 50) - 1
    assert row["ticks"] == 125 - first_tick
    assert row["stall_ticks"] > 30
    assert row["boundaries"] == 2
    assert (row["stalled_cycles"], row["p_stall_cycle"]) == (1, 1 / 2)
    assert row["latency_s_p99"] > 2  # it came after all


def test_the_last_answer_of_a_mode_is_waited_for_and_is_none_of_the_next(tmp_path: Path) -> None:
    latency = recording(tmp_path, 10, 10, 10, 10, 700, *[10] * 400)
    rows = act(tmp_path / "runs", modes="sync,queue?trigger=3", latency=latency, seconds=0.5, control_hz=200)
    samples = read_run(folder_of(tmp_path / "runs")).samples
    assert (samples["error"] == "").all()
    assert len(samples) - 1 == rows["requests"].sum()
    assert sorted(rows["latency_s_p99"] > 0.6) == [False, True]


def fails(*_: object) -> None:
    raise EngineError("out of batteries")


@pytest.mark.parametrize(
    ("answers", "error", "says"),
    [
        (fails, S2AError, "out of batteries"),
        (lambda *args: islice(chunk(*args), 5), UsageError, "`horizon`: loopback answers with chunks of 5 actions"),
        (lambda *_: [Token(0, "go")], RequestFailed, "chunks of actions"),
    ],
    ids=["no warm-up succeeds", "another length", "no actions"],
)
def test_answers_that_no_robot_can_act_on_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answers: object, error: type[S2AError], says: str
) -> None:
    monkeypatch.setattr("s2a_bench.inference.echo.chunk", answers)
    with pytest.raises(error, match=says):
        act(tmp_path, modes="sync")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rules": "mean,oracle"}, "`rules`: 'oracle' is not one of calibrated, tracked, maximum, mean"),
        ({"rules": "tracked"}, "`warmup`: 5 requests are too few to learn from for `epsilon` 0.01; take 99"),
        ({"seconds": 80_000, "control_hz": 1000}, "`seconds`: 80000 s at `control_hz` 1000 are over"),
        ({"control_hz": 1e6}, "`control_hz`: 1000000.0 should be less than or equal to 10000"),
        ({"control_hz": 0.1, "seconds": 1}, "`seconds`: 1 s are less than two ticks at `control_hz` 0.1"),
        ({"cycles": 5}, "`cycles` is not one of the options"),
        ({"control_hz": 1e-300}, "`control_hz`"),
        ({"requests": {"transports": "nothing"}}, "nothing"),
        ({"requests": {"engine": {"name": "llama"}}}, "echo or replay"),
        ({"export_delays": "delays.txt"}, "`export_delays`: delays.txt should be"),
        ({"export_delays": "d.csv", "requests": {"transports": "http,ros"}}, "one `transport` at a time"),
    ],
)
def test_what_makes_no_sense_is_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ChunksLive(**options)


def test_without_websockets_packages_it_goes_over_http() -> None:
    program = """
import sys
sys.modules["websockets"] = None
from s2a_bench.plugins.chunks.chunks.config import ChunksLive
print(*ChunksLive().requests.transports)
"""
    program_run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert program_run.stdout.split() == ["http/binary"]


def test_a_policy_server_of_somebody_elses_moves_the_loop(tmp_path: Path) -> None:
    requests = {"transports": "websocket", "size": "64x48", "state": 3, "warmup": 1}
    with policy_server() as url:
        config = ChunksLive(seconds=2, horizon=10, modes="queue?trigger=4,sync", requests={**requests, "url": url})
        run = read_run(run_live(config, tmp_path, NullProgress()))
    table = run.table(CHUNKS)
    assert table["agreement"].notna().all()
    assert (table["latency_s"] >= 0.05).all()
    assert (table.loc[table["mode"] == "sync", "stall_ticks"] > 0).all()
    assert run.origins.of(table["cell"].iloc[0]).engine == "unknown"
