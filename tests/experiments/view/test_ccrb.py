"""What is shown of closed loops: their roll-outs and their requests' stages beside them, a figure, a recording."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import jsonschema
import numpy as np
import pandas as pd
import pytest
from rosbags.highlevel import AnyReader

from s2a_bench.boards.profile import to_toml
from s2a_bench.cli.progress import RunProgress
from s2a_bench.errors import UsageError
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.ccrb.config import CcrbClosedLoop, CcrbComputed, CcrbLiveLoop, DrivingRequests
from s2a_bench.experiments.ccrb.loop import ClosedLoop
from s2a_bench.experiments.ccrb.rows import ROLLOUTS, TRAJECTORIES
from s2a_bench.experiments.ccrb.view.figures import DrivenPlan, build_phase, build_scenario, path_of
from s2a_bench.experiments.ccrb.view.outcomes import Rollouts
from s2a_bench.experiments.ccrb.view.tables import show
from s2a_bench.inference import EngineConfig
from s2a_bench.options import Options
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.writers.figures import caption_of
from tests.made_runs import SCHEMA

POLICIES = ("naive", "wait-then-act", "stream-to-act")
TOPICS = {policy: f"/s2a_bench/{policy.replace('-', '_')}" for policy in POLICIES}


def run(folder: Path, config: Options) -> StoredRun:
    with RunProgress() as progress:
        return read_run(EXPERIMENTS["ccrb"].run_with(config, folder, progress))


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    return run(tmp_path_factory.mktemp("runs"), CcrbClosedLoop())


class Live(NamedTuple):
    run: StoredRun
    recording: Path


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Live:
    """Closed loops on the clock with a board of 120 tokens a second, recorded."""
    folder = tmp_path_factory.mktemp("runs")
    facts = {"title": "A board", "origin": "measured", "tokens_per_s": 120.0, "prompt_s": 0.05}
    (folder / "fast.toml").write_text(to_toml({**facts, "gaps": {"family": "constant"}}))
    engine = EngineConfig(name="replay", profile=str(folder / "fast.toml"))
    requests = DrivingRequests(transports="http/binary", engine=engine, record=folder / "run.mcap")
    made = run(folder, CcrbLiveLoop(requests=requests, scenario=CcrbOptions(n_skills=3, speed_kmh=20, t_nom_s=0.4)))
    return Live(made, folder / "run.mcap")


class Message(NamedTuple):
    at_ns: int
    data: Any


@pytest.fixture(scope="module")
def recorded(live: Live) -> dict[str, list[Message]]:
    """Return topic -> messages, as a reader finds them that has no types but the file's."""
    found = defaultdict(list)
    with AnyReader([live.recording]) as reader:
        for connection, at_ns, raw in reader.messages():
            found[connection.topic].append(Message(at_ns, reader.deserialize(raw, connection.msgtype)))
    return found


def test_a_closed_loop_is_followed_by_its_roll_out(virtual: StoredRun) -> None:
    table = show(virtual).tables["outcomes"]
    assert table.header[-2:] == ("real-time factor", "tracking m/s")
    assert [row[:4] for row in table.rows] == [
        ("naive", "hit from behind", "1.75", "4"),
        ("  roll-out", "hit from behind", "1.75", "4"),
        ("wait-then-act", "hits the lead", "6.75", "0"),
        ("  roll-out", "hits the lead", "6.75", "0"),
        ("stream-to-act", "no impact", "3.55", "0"),
        ("  roll-out", "no impact", "3.55", "0"),
    ]
    assert [row[-2] for row in table.rows] == ["1.00", "\N{EN DASH}"] * 3
    printed = show(virtual).json()
    jsonschema.validate(printed, SCHEMA)
    assert [(cell["policy"], cell["outcome"]) for cell in printed["rollouts"]] == [
        ("naive", "rear"),
        ("wait-then-act", "front"),
        ("stream-to-act", "none"),
    ]
    assert [cell["policy"] for cell in printed["cells"]] == list(POLICIES)


def test_a_run_without_closed_loops_has_no_roll_outs_beside_it(tmp_path: Path) -> None:
    made = run(tmp_path, CcrbComputed())
    table = show(made).tables["outcomes"]
    assert [row[0] for row in table.rows] == list(POLICIES)
    assert "real-time factor" not in table.header
    assert "rollouts" not in show(made).json()
    assert not any("loop" in note for note in table.notes)
    assert [axes.get_title("left") for axes in show(made).figures["scenario"]().axes[:3]] == [
        "naive: hit from behind",
        "wait-then-act: hits the lead",
        "stream-to-act: no impact",
    ]


def test_the_notes_say_which_clock_the_world_had_and_what_it_was_asked(virtual: StoredRun, live: Live) -> None:
    notes = [" ".join(show(made).tables["outcomes"].notes) for made in (virtual, live.run)]
    assert "the world ran in virtual time, in steps of 5 ms, while the plan arrived" in notes[0]
    assert "the world ran on the clock, in steps of 20 ms, while the plan arrived" in notes[1]
    assert all("Roll-out: the same arrivals in virtual time, longitudinal simulator." in each for each in notes)
    assert "A request a policy, about the view at that moment." in notes[1]
    assert "What the plan says is not driven; the set-points driven are those of the scenario." in notes[1]
    assert "car simulated" in notes[1]
    assert not any("Open loop" in each for each in notes)


@pytest.mark.parametrize(("factor", "told"), [(0.634, "factor 0.634 (naive), 0.634 (wait-then-act)"), (0.995, "")])
def test_a_world_slower_than_the_clock_is_told_with_its_factor(
    factor: float, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ClosedLoop, "real_time_factor", factor)
    made = run(tmp_path, CcrbClosedLoop(policies=POLICIES[:2]))
    slow = [note for note in show(made).tables["outcomes"].notes if "slower than the clock" in note]
    assert [told in note for note in slow] == [True] * bool(told)
    assert [note.labels for note in slow] == [("world slower than the clock",)] * bool(told)  # type: ignore[attr-defined]
    assert ("slower than the clock" in " ".join(caption_of(show(made).figures["scenario"]()))) is bool(told)


def test_each_policy_has_a_request_of_its_own_and_its_roll_out_beside_it(live: Live) -> None:
    skills = live.run.table(SKILLS)
    assert list(skills.groupby("cell", sort=False)["request_id"].nunique()) == [1, 1, 1]
    assert skills["request_id"].nunique() == 3
    assert set(live.run.manifest["requests"]) == set(skills["request_id"])
    assert live.run.manifest["configuration"]["time"] == "monotonic"
    assert 0 <= live.run.table(TRAJECTORIES).groupby("cell")["at_ns"].min().max() < 200e6
    assert live.run.table(ROLLOUTS)["study"].value_counts().to_dict() == {"point": 3, "rollout": 3}


def test_each_policys_request_has_its_stages_and_they_add_up(virtual: StoredRun, live: Live) -> None:
    table = show(live.run).tables["stages"]
    assert table.header[0] == "policy"
    assert {"capture", "pack", "network", "inference", "return"} < set(table.header)
    assert table.header[-3:] == ("residual", "TTFT", "e2e")
    assert [row[0] for row in table.rows] == list(POLICIES)
    samples = live.run.samples.set_index("request_id")
    asked = live.run.table(SKILLS).groupby("cell", sort=False)["request_id"].first()
    assert len(set(asked)) == 3
    for row, request in zip(table.rows, asked, strict=True):
        shown = dict(zip(table.header, row, strict=True))
        sample = samples.loc[request]
        for name, column in (("TTFT", "ttft_ns"), ("e2e", "e2e_ns"), ("inference", "inference_ns")):
            assert float(shown[name]) == pytest.approx(sample[column] / 1e6, rel=0.01)
        assert sum(float(entry) for entry in row[1:-2]) == pytest.approx(sample["e2e_ns"] / 1e6, rel=0.02)
    assert table.notes[0].startswith("EMULATED (replayed) tokens over http/binary")
    assert "stages" not in show(virtual).tables


def test_the_figure_names_the_roll_out_and_marks_the_first_token(virtual: StoredRun) -> None:
    figure = show(virtual).figures["scenario"]()
    assert [axes.get_title("left") for axes in figure.axes[:3]] == [
        "naive: hit from behind\nroll-out: hit from behind",
        "wait-then-act: hits the lead\nroll-out: hits the lead",
        "stream-to-act: no impact\nroll-out: no impact",
    ]
    cells = list(virtual.table(ROLLOUTS)["cell"].unique())
    for place, axes in enumerate(figure.axes):
        marks = [line for line in axes.lines if line.get_linestyle() == "-."]
        firsts = [float(np.asarray(line.get_xdata())[0]) for line in marks]
        assert firsts == [Rollouts.of(virtual).token_s(cells[place % 3])[0]]
    assert "CCRB with a car behind (longitudinal simulator, closed loop)" in caption_of(figure)[0]


def test_no_skill_is_drawn_beyond_what_was_driven(virtual: StoredRun) -> None:
    axes = show(virtual).figures["scenario"]().axes[1]
    driven_s = max(float(np.max(line.get_xdata())) for line in axes.lines if len(np.asarray(line.get_xdata())) > 50)
    ends_s = [patch.get_x() + patch.get_width() for patch in axes.patches]  # type: ignore[attr-defined]
    assert max(ends_s) == pytest.approx(driven_s)


def trajectory() -> pd.DataFrame:
    """Return five seconds of a lead 30 m ahead and a rear car that closes 10 m; all stop after two seconds."""
    at_s = np.arange(0, 5, 0.5)
    speed, gap = np.where(at_s < 2.5, 10.0, 0.0), np.linspace(6.0, -12.0, len(at_s))
    columns = {"at_ns": at_s * 1e9, "lead_position_m": at_s + 30, "ego_position_m": at_s, "rear_position_m": at_s - gap}
    return pd.DataFrame({**columns, **{f"{car}_speed_mps": speed for car in ("lead", "ego", "rear")}})


def test_a_path_ends_a_second_after_the_cars_rest_and_the_rear_car_at_its_impact() -> None:
    path = path_of(trajectory(), hit_from_behind=True)
    assert path["time_s"].max() == 3.0
    assert path["rear_gap_m"].isna().tolist() == [False] * 4 + [True] * 3
    assert path["ego_speed_mps"].notna().all()
    assert path_of(trajectory(), hit_from_behind=False)["rear_gap_m"].notna().all()


def test_a_scenario_is_drawn_from_a_path_skills_and_tokens() -> None:
    skills = pd.DataFrame({"start_ns": [1e9, 3e9], "end_ns": [2e9, 4e9], "stall_ns": [0.0, 1e9]})
    plan = DrivenPlan("naive", path_of(trajectory(), hit_from_behind=True), skills, [0.5, 0.7], {"rear": 4.0})
    figure = build_scenario(("A title",), [plan])
    assert [text.get_text() for axes in figure.axes for text in axes.texts] == ["4.0 m/s"]
    spans = [(patch.get_x(), patch.get_width()) for patch in figure.axes[0].patches]  # type: ignore[attr-defined]
    assert spans == [(0.0, 1.0), (1.0, 1.0), (2.0, 1.0)]  # waiting, a skill, a stall; the second skill is not driven


def test_a_phase_diagram_is_drawn_from_scenarios() -> None:
    outcomes = {"naive": ["rear", "none"] * 2, "wait-then-act": ["front"] * 4, "stream-to-act": ["none"] * 4}
    plane = {"tokens_per_s": [2.0, 4.0] * 2, "rear_gap_m": [6.0, 6.0, 9.0, 9.0], "paper": [True, False] * 2}
    figure = build_phase(("A title",), dict.fromkeys(GAPS, pd.DataFrame({**plane, **outcomes})), (2.0, 8.0))
    assert figure.axes[0].get_title("left") == "stop: the paper's ordering 50.0%, at 8 m: R 2.0\N{EN DASH}2.0"
    (legend,) = figure.legends
    labels = ["the paper's ordering", "only wait-then-act has an impact", "operating point"]
    assert [text.get_text() for text in legend.get_texts()] == labels


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    """A board that is still writing its first skill when the lead is hit."""
    return run(tmp_path_factory.mktemp("runs"), CcrbClosedLoop(rate=0.3, policies=("naive",)))


def test_tokens_that_come_after_the_crash_are_not_drawn(slow: StoredRun) -> None:
    figure = show(slow).figures["scenario"]()
    figure.canvas.draw()  # a layout without room would warn
    (marks,) = (line for line in figure.axes[0].lines if line.get_marker() == "|")
    assert marks.get_clip_on()


def test_tracking_is_absent_where_no_skill_ran_before_the_crash(slow: StoredRun) -> None:
    (cell,) = show(slow).json()["cells"]
    assert cell["outcome"] == "front"
    assert cell["real_time_factor"] == pytest.approx(1.0)
    assert "tracking_rms_mps" not in cell


def test_a_recording_has_every_policys_cars_where_they_drove(live: Live, recorded: dict[str, list[Message]]) -> None:
    paths = live.run.table(TRAJECTORIES)
    for policy, topic in TOPICS.items():
        path = paths[paths["cell"].str.endswith(f"/{policy}")]
        zero_ns = recorded[f"{topic}/ego/odom"][0].at_ns - int(path["at_ns"].iloc[0])
        for car in ("lead", "ego", "rear"):
            odometry = recorded[f"{topic}/{car}/odom"]
            poses = [message.data.pose.pose for message in odometry]
            assert [pose.position.x for pose in poses] == pytest.approx(list(path[f"{car}_position_m"]))
            speeds = [message.data.twist.twist.linear.x for message in odometry]
            assert speeds == pytest.approx(list(path[f"{car}_speed_mps"]))
            assert {(pose.orientation.x, pose.orientation.w) for pose in poses} == {(0.0, 1.0)}
            assert [message.at_ns - zero_ns for message in odometry] == pytest.approx(list(path["at_ns"]), abs=2)
            stamps = [message.data.header.stamp for message in odometry]
            assert [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps] == [message.at_ns for message in odometry]
            assert {(each.data.header.frame_id, each.data.child_frame_id) for each in odometry} == {("road", car)}


def test_a_recording_has_every_skill_when_it_started_and_ended(live: Live, recorded: dict[str, list[Message]]) -> None:
    skills = live.run.table(SKILLS)
    for policy, topic in TOPICS.items():
        mine = skills[skills["cell"].str.endswith(f"/{policy}")]
        said = recorded[f"{topic}/skill"]
        texts = [f"set_speed({speed}) {what}" for speed in ("13.3", "6.7", "0") for what in ("starts", "ends")]
        assert [message.data.data for message in said] == texts
        since_ns = np.array([message.at_ns for message in said]) - said[0].at_ns
        expected_ns = mine[["start_ns", "end_ns"]].to_numpy().ravel()
        assert since_ns == pytest.approx(expected_ns - expected_ns[0], abs=10)


def test_a_recording_has_the_egos_view_and_the_requests_with_their_pictures(
    recorded: dict[str, list[Message]],
) -> None:
    for topic in TOPICS.values():
        pictures = recorded[f"{topic}/ego/camera/image_raw"]
        assert {(each.data.width, each.data.height, each.data.encoding) for each in pictures} == {(320, 240, "bgr8")}
        stamps = [each.data.header.stamp for each in pictures]
        assert [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps] == [each.at_ns for each in pictures]
        apart_ns = np.diff([message.at_ns for message in pictures])
        assert len(apart_ns) >= 3
        assert apart_ns.min() > 150_000_000
        assert pictures[0].at_ns < recorded[f"{topic}/ego/odom"][0].at_ns  # it is seen before the request too
        assert (pictures[0].data.data != pictures[-1].data.data).any()
    assert len(recorded["/s2a_bench/camera/image_raw"]) == 4  # the warm-up's too
    assert len(recorded["/s2a_bench/http/binary/request"]) == 4
    assert len(recorded["/s2a_bench/http/binary/token"]) == 4 * 18


def test_a_recording_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    with pytest.raises(UsageError, match=r"`record`: .*run\.mcap exists already and is not overwritten"):
        DrivingRequests(transports="loopback", engine=EngineConfig(name="replay"), record=tmp_path / "run.mcap")
