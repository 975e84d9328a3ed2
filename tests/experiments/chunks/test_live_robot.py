"""Robots of live runs: what they are told, what requests are told of them, and what is measured on a plant."""

import sys
from pathlib import Path
from types import ModuleType

import pytest

from s2a_bench.errors import RobotError, UsageError
from s2a_bench.experiments.chunks.config import ChunksConfig
from s2a_bench.experiments.chunks.view import show
from s2a_bench.harness.session import Asked, Measured, Place, Session
from s2a_bench.store.run import read_run
from s2a_bench.types import Vector
from tests.experiments.chunks.test_live import ECHO, act, folder_of


def test_a_plant_moves_and_is_measured(tmp_path: Path) -> None:
    rows = act(tmp_path, modes="queue?trigger=4,sync,aggregate?trigger=4", robot="plant?frequency_hz=3")
    assert (rows["jerk_rms"] > 0).all()
    assert (rows["boundary_jump_p99"] >= rows["boundary_jump_mean"]).all()
    assert rows["tracking_rms"].isna().all()
    run = read_run(folder_of(tmp_path))
    assert run.manifest["robot"] == {"robot": "plant", "frequency_hz": "3", "damping": "1"}
    table = show(run).tables["smoothness"]
    assert table.header == ("mode", "jerk", "jump", "p99", "step")
    assert any("Jerk (root mean square) of plant?frequency_hz=3" in note for note in table.notes)
    assert not any("EMULATED" in note for note in table.notes)


def test_a_robot_s_state_goes_with_requests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[float, ...]] = []
    measure = Session.measure

    def spy(self: Session, place: Place, asked: Asked) -> Measured:
        if not place.warmup:
            told.append(asked.state or ())
        return measure(self, place, asked)

    monkeypatch.setattr(Session, "measure", spy)
    requests = {"transports": "loopback", "engine": {**ECHO, "action_dim": 2}, "size": "64x48", "warmup": 1}
    act(tmp_path, modes="queue?trigger=4", robot="plant", requests=requests)
    assert told[0] == (0, 0)
    assert all(len(state) == 2 for state in told)
    assert len(set(told)) > 1


def test_every_action_reaches_a_function(tmp_path: Path, arm: ModuleType) -> None:
    seen: list[Vector] = []
    vars(arm)["move"] = seen.append
    rows = act(tmp_path, modes="sync", robot="call?function=somebodys_arm:move")
    assert {action.shape for action in seen} == {(7,)}
    assert len(seen) >= rows["ticks"].item() - rows["stall_ticks"].item()
    assert rows["jerk_rms"].isna().all()
    assert "smoothness" not in show(read_run(folder_of(tmp_path))).tables


def test_an_action_that_a_robot_fails_at_ends_the_run(tmp_path: Path, arm: ModuleType) -> None:
    def move(action: Vector) -> None:
        raise RuntimeError(f"{action.size} joints are too many")

    vars(arm)["move"] = move
    with pytest.raises(RobotError, match="`robot`: call: somebodys_arm:move: RuntimeError: 7 joints are too many"):
        act(tmp_path, modes="sync", robot="call?function=somebodys_arm:move")


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType("somebodys_arm")
    monkeypatch.setitem(sys.modules, "somebodys_arm", module)
    return module


def test_without_a_robot_actions_go_nowhere(tmp_path: Path) -> None:
    assert act(tmp_path, modes="sync", robot="")["jerk_rms"].isna().all()


def test_a_robot_is_refused_before_anything_runs() -> None:
    with pytest.raises(UsageError, match="`robot`: call: function = '' should look like module:name"):
        ChunksConfig(live=True, robot="call")
