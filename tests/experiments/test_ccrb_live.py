"""`ccrb --live`: one request about the rendered scene, and every policy driven on the arrivals of its tokens."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.experiments.ccrb.config import CcrbLive, CcrbLiveLoop, DrivingRequests
from s2a_bench.experiments.ccrb.live import run_live, run_live_loop
from s2a_bench.experiments.ccrb.rows import ROLLOUTS
from s2a_bench.experiments.ccrb.view.outcomes import Rollouts, origin_notes
from s2a_bench.experiments.ccrb.view.tables import show
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.models import tiny_dummy
from s2a_bench.scenario import SIMULATORS
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.store.requests import SKILLS, TOKENS
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.trace import Trace
from s2a_bench.transport.loopback.in_process import LoopbackClient
from s2a_bench.types import Request, Token
from tests.made_runs import SCHEMA
from tests.scenario.carla_stand_in import RosSimulator

N, L, T_NS = 3, 6, 800_000_000


def asked(engine: EngineConfig) -> DrivingRequests:
    return DrivingRequests(transports="loopback", engine=engine)


def replayed(profile: str) -> DrivingRequests:
    return asked(EngineConfig(name="replay", profile=profile))


def drive(requests: DrivingRequests, folder: Path) -> StoredRun:
    config = CcrbLive(scenario=CcrbOptions(n_skills=N), tokens_per_skill=L, requests=requests)
    return read_run(run_live(config, folder, NullProgress()))


@pytest.fixture(scope="module")
def paced(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    """The tiny dummy model, held back to 40 tokens a second."""
    return drive(asked(EngineConfig(threads=1, pace=40.0)), tmp_path_factory.mktemp("runs"))


def test_every_policy_drives_on_the_arrivals_that_the_client_recorded(paced: StoredRun) -> None:
    token_ns = np.rint(np.array(Rollouts.of(paced).token_s(paced.table(SKILLS)["cell"].iloc[0])) * 1e9).astype(np.int64)
    assert len(token_ns) == N * L
    arrivals_ns = token_ns[L - 1 :: L]
    skills = paced.table(SKILLS)
    assert list(skills["text"][:N]) == ["set_speed(33.3)", "set_speed(16.7)", "set_speed(0)"]  # whatever was written
    by_policy = {cell.rsplit("/", 1)[1]: rows for cell, rows in skills.groupby("cell", sort=False)}
    assert list(by_policy) == ["naive", "wait-then-act", "stream-to-act"]
    for rows in by_policy.values():
        assert rows["arrival_ns"].to_numpy() == pytest.approx(arrivals_ns, abs=2)
    starts_ns = [int(arrivals_ns[0])]
    for arrival_ns in arrivals_ns[1:]:
        starts_ns.append(max(int(arrival_ns), starts_ns[-1] + T_NS))
    assert by_policy["naive"]["start_ns"].to_numpy() == pytest.approx(starts_ns, abs=4)
    assert by_policy["wait-then-act"]["start_ns"].iloc[0] == pytest.approx(arrivals_ns[-1], abs=2)


def test_each_request_has_a_picture_of_its_own_and_the_warm_up_is_marked(paced: StoredRun) -> None:
    samples = paced.samples
    assert list(samples["frame_index"]) == [0, 1]
    assert list(samples["warmup"]) == [True, False]
    assert set(paced.table(TOKENS)["request_id"]) == set(samples["request_id"])
    assert paced.manifest["configuration"]["live"]["source"] == "camera of longitudinal"


def test_a_paced_dummy_is_live_and_says_what_is_set_and_what_means_nothing(paced: StoredRun) -> None:
    notes = " ".join(origin_notes(Rollouts.of(paced)))
    assert "LIVE tokens over loopback, paced to 40 tokens/s (the rate is set); car simulated." in notes
    assert "Dummy weights: what the plan says means nothing" in notes
    assert "Open loop: one request at t = 0" in notes
    assert "EMULATED" not in notes
    printed = show(paced).json()
    jsonschema.validate(printed, SCHEMA)
    assert {cell["emulated"] for cell in printed["cells"]} == {False}
    assert {cell["rate_tokens_per_s"] for cell in printed["cells"]} == {40.0}
    assert not any("prompt_s" in cell for cell in printed["cells"])
    assert (printed["live"]["dummy"], printed["live"]["robot"]) == (True, "longitudinal simulator")


def test_a_text_model_is_live_and_its_tokens_say_that_the_scene_is_not_seen(tmp_path: Path) -> None:
    model = tmp_path / "texts.gguf"
    model.symlink_to(tiny_dummy()[0])
    engine = EngineConfig(model=model, threads=1)
    run = drive(asked(engine), tmp_path / "runs")
    first = origin_notes(Rollouts.of(run))[0]
    assert first.startswith("LIVE tokens over loopback, picture not seen; car simulated.")
    assert first.labels == ("picture not seen",)  # type: ignore[attr-defined]
    printed = show(run).json()
    jsonschema.validate(printed, SCHEMA)
    assert printed["provenance"]["run"]["pictures"] == "not seen"


def test_a_replayed_profile_stays_emulated(fast_board: str, tmp_path: Path) -> None:
    run = drive(replayed(fast_board), tmp_path / "runs")
    assert run.table(ROLLOUTS)["emulated"].all()
    first = origin_notes(Rollouts.of(run))[0]
    assert first.startswith("EMULATED (replayed) tokens over loopback; car simulated. 1")
    assert first.endswith(" tokens/s arrived.")
    assert show(run).json()["live"]["emulated"] is True


def test_a_plan_that_is_not_whole_ends_the_run_and_keeps_what_came(
    fast_board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = LoopbackClient.request

    def cut(self: LoopbackClient, request: Request, trace: Trace) -> Iterator[Token]:
        for token in whole(self, request, trace):
            if token.index < L:
                yield token

    monkeypatch.setattr(LoopbackClient, "request", cut)
    message = r"loopback: 1 of 3 skills arrived; .*tokens\.csv has what the model wrote"
    with pytest.raises(TransportError, match=message):
        drive(replayed(fast_board), tmp_path / "runs")
    (folder,) = (tmp_path / "runs").iterdir()
    assert len(read_run(folder).table(TOKENS)) == 2 * L


def test_the_ego_is_commanded_and_seen_over_ros_while_its_plan_arrives(
    fast_board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 only")
    monkeypatch.setitem(SIMULATORS._builtins, "stand-in", "tests.scenario.carla_stand_in:RosSimulator")
    monkeypatch.setattr(RosSimulator, "opened", [])
    ego = "ros?middleware=cyclonedds&wait_s=60"
    config = CcrbLiveLoop(
        scenario=CcrbOptions(n_skills=N),
        tokens_per_skill=L,
        requests=replayed(fast_board),
        policies=("naive",),
        simulator="stand-in",
        ego=ego,
    )
    run = read_run(run_live_loop(config, tmp_path, NullProgress()))
    (world,) = RosSimulator.opened
    driven = run.table(ROLLOUTS).query("study == 'point'")
    assert list(driven["simulator"]) == ["stand-in"]
    assert run.manifest["configuration"]["ego"] == ego
    assert f"Ego: commanded and seen over ROS 2 ({ego})." in origin_notes(Rollouts.of(run))
    assert len(run.samples) == 2
    pedals = [(message.throttle, message.brake) for message in world.received]
    assert any(throttle > 0.03 and brake == 0 for throttle, brake in pedals)  # it kept its speed
    assert any(throttle == 0 and 0.1 < brake < 1 for throttle, brake in pedals)  # and braked as planned
    assert world.closed == 2  # by the ego, and by the run


@pytest.mark.parametrize(
    ("ego", "says"),
    [
        ("ros", "the embedded simulator has no ROS 2; take a `simulator` that has: "),
        ("dds", "'dds' should be ros, with parameters as in ros?preset=bridge"),
    ],
)
def test_an_ego_that_cannot_be_reached_is_refused_before_anything_is_opened(ego: str, says: str) -> None:
    with pytest.raises(UsageError, match=r"^`ego`: ") as error:
        CcrbLiveLoop(simulator="embedded", ego=ego)
    assert says in str(error.value)
