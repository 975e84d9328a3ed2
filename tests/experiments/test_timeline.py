"""Timeline runs in virtual time: the same arrivals for every policy, reproducible, calibrated, whole in their rows."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from s2a_bench.boards.gaps import Constant, Lognormal, Markov, Recorded
from s2a_bench.boards.profile import Profile
from s2a_bench.boards.tokens import board_of_profile, gaps_of
from s2a_bench.errors import StoreError, UsageError
from s2a_bench.experiments.timeline.build_rows import share, timeline_rows
from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.rows import METRICS, TIMELINES, TimelineRow
from s2a_bench.experiments.timeline.run import recordings, run_timeline
from s2a_bench.experiments.timeline.view.cells import timelines_of
from s2a_bench.experiments.timeline.view.tables import show
from s2a_bench.harness.timelines.cases import LearningPlan, PlanSetting
from s2a_bench.harness.timelines.policies import draw, learn
from s2a_bench.harness.timelines.rows import KEPT_PLANS
from s2a_bench.policy import Plans, Schedule
from s2a_bench.policy.conformal import Calibration
from s2a_bench.policy.schedule import safe_start
from s2a_bench.policy.stream_to_act import StreamToAct
from s2a_bench.store.requests import SKILLS, TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from s2a_bench.testing import NullProgress
from tests.made_runs import marks_of, row_of

JITTERY = TimelineComputed(profiles=("jetson-agx-orin",), tokens_per_skill=(6,), jitter="profile", plans=300)


def ran(config: TimelineComputed, output: Path) -> StoredRun:
    return read_run(run_timeline(config, output, NullProgress()))


def test_every_policy_meets_the_same_arrivals(tmp_path: Path) -> None:
    rows = ran(JITTERY, tmp_path).table(TIMELINES)
    for _, same in rows.groupby("plan"):
        assert len(same) == 3
        assert same["request_id"].nunique() == same["last_arrival_ns"].nunique() == same["safe_start_ns"].nunique() == 1
    assert rows["last_arrival_ns"].nunique() > 290


def test_a_seed_repeats_a_run_and_another_seed_does_not(tmp_path: Path) -> None:
    texts = []
    for place, seed in enumerate((3, 3, 4)):
        run = ran(JITTERY.but(plans=5, seed=seed), tmp_path / str(place))
        texts.append((run.path / "skills.csv").read_text())
    assert texts[0] == texts[1] != texts[2]


def test_skills_stalls_and_metrics_of_a_plan_fit_together(tmp_path: Path) -> None:
    run = ran(JITTERY, tmp_path)
    rows = run.table(TIMELINES).set_index(["cell", "request_id"])
    for key, skills in run.table(SKILLS).groupby(["cell", "request_id"]):
        row = rows.loc[key]
        assert list(skills["index"]) == list(range(8))
        assert row["start_ns"] == skills["start_ns"].iloc[0]
        assert abs(row["end_ns"] - skills["end_ns"].iloc[-1]) <= 1
        gaps = skills["start_ns"].to_numpy()[1:] - skills["end_ns"].to_numpy()[:-1]
        assert np.abs(gaps - skills["stall_ns"].to_numpy()[1:]).max() <= 1
        assert abs(row["stall_ns"] - skills["stall_ns"].sum()) <= 8
        assert (skills["start_ns"] >= skills["arrival_ns"]).all()
        longest = skills["end_ns"] - skills["start_ns"] - skills["most_ns"]
        assert longest.max() <= 1
    assert len(run.table(SKILLS)) == 3 * KEPT_PLANS * 8
    moving = run.table(TIMELINES)[run.table(TIMELINES)["rms_jerk"].notna()]
    assert set(moving["plan"]) == set(range(KEPT_PLANS))


def test_stream_to_act_keeps_its_promise_where_naive_and_the_mean_rule_stall(tmp_path: Path) -> None:
    run = ran(JITTERY.but(policies=("naive", "s2a-mean", "stream-to-act"), plans=1000), tmp_path)
    share = {cell.policy: cell.p_any_stall for cell in timelines_of(run)}
    assert share["stream-to-act"] <= 0.02
    assert share["s2a-mean"] > 0.3
    assert share["naive"] > 0.9
    (found,) = run.manifest["calibrations"].values()
    assert found["plans"] == 400
    assert found["caution"] == run.table(TIMELINES).query("policy == 'stream-to-act'")["caution"].iloc[0] > 0


@given(
    rate=st.floats(0.1, 50),
    prompt_s=st.floats(0, 5),
    tokens=st.integers(1, 8),
    skills=st.integers(1, 20),
    t_nom_s=st.floats(0.05, 8),
)
def test_online_without_jitter_starts_at_the_safe_start_exactly(
    rate: float, prompt_s: float, tokens: int, skills: int, t_nom_s: float
) -> None:
    plan = {"tokens_per_skill": (tokens,), "n_skills": (skills,), "t_nom_s": (t_nom_s,)}
    (case,) = TimelineComputed(profiles=(), rates=(rate,), prompt_s=prompt_s, **plan).cases
    _, plans = draw(case, 0, 1, "plans")
    schedule = learn(case, LearningPlan({"online": StreamToAct()}, 0)).by_name["online"].schedule(plans)
    safe_s = safe_start(plans.arrival_s, plans.nominal_s)
    assert schedule.start_s[0] == pytest.approx(safe_s, rel=1e-9, abs=1e-9)
    end_s = schedule.start_s[-1] + schedule.duration_s[-1]
    assert end_s == pytest.approx(safe_s + skills * t_nom_s, rel=2e-5)


def test_drawn_tokens_have_the_rate_and_prompt_time_of_their_board() -> None:
    profile = Profile("p", "P", "paper", 5.0, 1.0, 0.3, Lognormal(0.2, 0.5), rate_cv=0.1)
    board = board_of_profile(profile, "profile", None)
    token_s = board.tokens(50, np.random.default_rng(0), 20_000)
    assert token_s[0].mean() == pytest.approx(1.0 + 0.2, rel=0.01)
    assert token_s[-1].mean() == pytest.approx(1.0 + 10, rel=0.01)
    expected_sd = np.hypot(0.3, np.hypot(10 * 0.1, 0.2 * 0.5 * 50**0.5))
    assert token_s[-1].std() == pytest.approx(expected_sd, rel=0.03)
    even = board_of_profile(profile, "none", 2.0)
    assert even.even
    assert even.prompt_origin == "given"
    assert even.tokens(2, np.random.default_rng(0), 1)[:, 0] == pytest.approx([2.2, 2.4])


def test_a_recording_is_played_where_a_profile_has_one_and_holds_the_spread_between_answers() -> None:
    parametric = Profile("p", "P", "measured", 5.0, 1.0, 0.0, Lognormal(0.2, 0.5), rate_cv=0.1)
    recorded = replace(parametric, trace_s=(0.1, 0.3))
    boards = [board_of_profile(*each, None) for each in ((parametric, "profile"), (recorded, "profile"))]
    assert [(board.gaps, board.rate_cv) for board in boards] == [
        (Lognormal(0.2, 0.5), 0.1),
        (Recorded(0.2, (0.1, 0.3)), 0),
    ]
    assert board_of_profile(recorded, "none", None).gaps == Constant(0.2)


def test_jitter_is_read_with_its_parameters() -> None:
    assert gaps_of("none", 0.5) == Constant(0.5)
    text = "markov:cv=0.2,pause_share=0.02,pause_ratio=10,pause_tokens=3"
    assert gaps_of(text, 0.5) == Markov(0.5, 0.2, 0.02, 10.0, 3.0)
    with pytest.raises(UsageError, match="`jitter` lognormal: cv: is missing"):
        gaps_of("lognormal", 0.5)
    with pytest.raises(UsageError, match="`jitter`: lognormal:cv: 'cv' should be key=number"):
        gaps_of("lognormal:cv", 0.5)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policies": ()}, "`policies`: name at least one"),
        ({"rates": (float("inf"),)}, "`rates`: inf"),
        ({"n_skills": (8, 0)}, "`n_skills`: 0 should be greater than or equal to 1"),
        ({"tokens_per_skill": (0,)}, "`tokens_per_skill`: 0"),
        ({"t_nom_s": (1e-9,)}, "`t_nom_s`: 1e-09"),
        ({"t_nom_cv": 0.6}, "`t_nom_cv`: 0.6"),
        ({"epsilon": 0.001}, "`epsilon`: calibrating on 400 promises 0.0025 at best"),
        ({"jitter": "lognormal:cv=1", "plans": 10**6}, "`plans`: .* skills are more than"),
        ({"n_skills": (1000,), "tokens_per_skill": (1000,)}, "`n_skills`, `tokens_per_skill`: 1000000 tokens a plan"),
        ({"profiles": ()}, "`profiles`: name at least one"),
        ({"policies": ("naive",), "track": True}, "`track`: no policy has a lambda to follow"),
        ({"policies": ("stream-to-act?caution=1",), "track": True}, "`track`: no policy has a lambda to follow"),
        ({"jitter": "none", "plans": None, "track": True}, "`track`: without `jitter` or `t_nom_cv`"),
    ],
)
def test_a_configuration_that_makes_no_sense_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        JITTERY.but(**fields)


def recorded_run(output: Path, answers: int, tokens: int, slower: int = 0) -> Path:
    """Make a run folder of answers at 5 tokens/s, the first token 1 s after the request, and one warm-up.

    Each answer's gaps are ``slower`` ns longer than those of the one before.
    """
    with RunWriter.create(output, "throughput", {}) as writer:
        for place in range(answers + 1):
            at = place * 10**12
            times = {"capture": 1, "inference": 1000, "return": 0}
            name = f"r{place}"
            writer.sample(
                row_of("loopback", times, place, request_id=name, marks=marks_of(times, at), warmup=not place)
            )
            writer.tokens(
                TokenRow(name, "loopback", i, 0, "x", None, at + 10**6 + 10**9 + i * (200_000_000 + place * slower))
                for i in range(tokens)
            )
        return writer.path


def test_answers_of_a_run_are_read_from_the_request(tmp_path: Path) -> None:
    found = recordings(recorded_run(tmp_path, 3, 4))
    assert len(found) == 3
    for token_s in found:
        assert token_s == pytest.approx([1.0, 1.2, 1.4, 1.6])


@pytest.mark.parametrize("slower", [0, 100_000])
def test_recorded_answers_calibrate(tmp_path: Path, slower: int) -> None:
    folder = recorded_run(tmp_path / "recorded", 120, 12, slower)
    config = TimelineComputed(profiles=(), rates=(5.0,), tokens_per_skill=(3,), n_skills=(4,), calibrate=folder)
    run = ran(config, tmp_path / "run")
    (found,) = run.manifest["calibrations"].values()
    assert found["plans"] == 120
    assert run.manifest["configuration"]["calibrate"] == str(folder)
    codes = [each["code"] for each in run.manifest["warnings"]]
    notes = " ".join(show(run).tables["timelines"].notes)
    assert ("not-exchangeable" in codes) == ("No promise about stalls" in notes) == bool(slower)
    assert ("of the plans stall on average" in notes) == (not slower)


def test_too_few_or_too_short_answers_are_refused_before_there_is_a_folder(tmp_path: Path) -> None:
    folder = recorded_run(tmp_path / "recorded", 120, 12)
    for skills, answers in ((5, 0), (4, 120)):
        config = TimelineComputed(
            profiles=(), rates=(5.0,), tokens_per_skill=(3,), n_skills=(skills,), calibrate=folder, epsilon=0.005
        )
        with pytest.raises(UsageError, match=f"{answers} of 120 answers have the {3 * skills} tokens"):
            run_timeline(config, tmp_path / "run", NullProgress())
    assert not (tmp_path / "run").exists()


def test_a_folder_without_a_run_or_answers_is_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="is not a run folder"):
        recordings(tmp_path)
    with pytest.raises(UsageError, match="holds no answers"):
        recordings(recorded_run(tmp_path, 0, 3))


def test_lambda_that_nothing_can_promise_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    never = Calibration(math.inf, 0.01, 400, 0, 0.0, 0.01, 0.99)
    monkeypatch.setattr("s2a_bench.harness.timelines.policies.choose", lambda *_: never)
    config = JITTERY.but(plans=20)
    run = ran(config, tmp_path)
    (warning,) = run.manifest["warnings"]
    assert warning["code"] == "calibration-waits"
    (found,) = run.manifest["calibrations"].values()
    assert found["caution"] is None
    online = next(cell for cell in timelines_of(run) if cell.policy == "stream-to-act")
    assert online.first.caution is None
    assert online.p_any_stall == 0
    assert all(plan.start_ns == plan.last_arrival_ns for plan in online.rows)


def test_each_setting_is_a_cell_a_policy(tmp_path: Path) -> None:
    config = TimelineComputed(profiles=("rtx-4080",), tokens_per_skill=(4, 1), n_skills=(2, 3), t_nom_s=(0.5, 2.0))
    rows = ran(config, tmp_path).table(TIMELINES)
    assert Counter(rows["policy"]) == dict.fromkeys(config.policies, 8)
    assert rows["cell"].nunique() == 24
    assert (rows["caution"].isna() == (rows["policy"] != "stream-to-act")).all()


def row_of_plan(arrival_s: np.ndarray, duration_s: np.ndarray) -> TimelineRow:
    """Make the row of a plan of skills of 1 s that start as they arrive and run for ``duration_s``."""
    nominal_s = np.ones(arrival_s.shape)
    plans = Plans(arrival_s, nominal_s, nominal_s, nominal_s)
    setting = PlanSetting("", "a rate", 4.0, 0.5, 1, len(arrival_s), 1.0)
    (made,) = timeline_rows(setting, "naive", plans, Schedule(arrival_s, duration_s), ["a"])
    return made


@pytest.mark.parametrize(
    ("arrival_s", "duration_s"), [([1.0], [0.0]), ([1.0, 2000.0], [1.0, 1.0])], ids=["fails at once", "long"]
)
def test_a_plan_without_time_or_of_hours_has_a_row_and_no_motion(
    arrival_s: list[float], duration_s: list[float]
) -> None:
    row = row_of_plan(np.array([arrival_s]).T, np.array([duration_s]).T)
    assert (row.start_ns, row.end_ns) == (10**9, round((arrival_s[-1] + duration_s[-1]) * 1e9))
    assert {row.rms_jerk, row.peak_jerk, row.sparc} == {None}


def test_every_metric_is_computed_and_kept_as_its_column_holds_it() -> None:
    row = row_of_plan(np.array([[0.25], [1.5]]), np.ones((2, 1)))
    expected = {
        "start_ns": 250_000_000,
        "stalls": 1,
        "any_stall": True,
        "stall_ns": 250_000_000,
        "stall_ratio": round(0.25 / 2.25, 9),
        "start_regret": 0.0,
        "signed_start_regret": -0.5,
    }
    assert {name: getattr(row, name) for name in expected} == expected
    assert {name: type(getattr(row, name)) for name in expected} == {
        name: type(each) for name, each in expected.items()
    }
    assert None not in [getattr(row, metric.column) for metric in METRICS.values()]
    assert str(share(-1e-12)) == "0.0"  # a rounding error


def test_followed_lambda_changes_from_plan_to_plan_and_keeps_the_stalls_rare(tmp_path: Path) -> None:
    bursts = JITTERY.but(policies=("stream-to-act",), jitter="lognormal:cv=0.6", plans=200, epsilon=0.05)
    rows = ran(bursts.but(track=True), tmp_path).table(TIMELINES)
    fixed = ran(bursts, tmp_path / "fixed").table(TIMELINES)
    assert fixed["caution"].nunique() == 1
    assert rows["caution"].nunique() > 1
    assert list(rows["last_arrival_ns"]) == list(fixed["last_arrival_ns"])
    # (level_1 + step) / (step T) = (.05 + .002) / (.002 * 200) above epsilon at most.
    assert rows["any_stall"].mean() <= 0.05 + 0.13


def test_every_online_rule_is_calibrated_for_itself(tmp_path: Path) -> None:
    early = "stream-to-act-early"
    config = JITTERY.but(policies=("stream-to-act", early, f"{early}?caution=1"), plans=50)
    run = ran(config, tmp_path)
    (case,) = config.cases
    found = run.manifest["calibrations"]
    assert set(found) == {case.setting.name, f"{case.setting.name}/{early}"}
    cautions = {cell.policy: cell.first.caution for cell in timelines_of(run)}
    assert cautions[early] == found[f"{case.setting.name}/{early}"]["caution"]
    assert cautions[f"{early}?caution=1"] == 1
    starts = {cell.policy: cell.mean("start_s") for cell in timelines_of(run)}
    assert starts[early] < starts["stream-to-act"]  # type: ignore[operator]


def test_a_guarantee_is_kept_with_the_calibration_and_said(tmp_path: Path) -> None:
    found = {}
    for guarantee in ("high-confidence", "expected"):
        run = ran(JITTERY.but(guarantee=guarantee, plans=20), tmp_path / guarantee)
        (found[guarantee],) = run.manifest["calibrations"].values()
        notes = " ".join(show(run).tables["timelines"].notes)
        assert f"--guarantee {guarantee}" in notes
        assert f"{found[guarantee]['expected_risk']:.2%} of the plans stall on average" in notes
    assert found["expected"]["expected_risk"] == 4 / 401
    assert found["high-confidence"]["expected_risk"] == 1 / 401
    assert found["expected"]["caution"] <= found["high-confidence"]["caution"]
