"""Live and real-time timelines: what is streamed is executed, and errors are reported and kept."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from s2a_bench.act.call import SkillMotion
from s2a_bench.errors import EngineError, ServerDied, SourceError, TransportError, UsageError
from s2a_bench.experiments.timeline.config import TimelineLive, TimelineRealTime
from s2a_bench.experiments.timeline.live import prompt_plan, run_live
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.run import run_real_time
from s2a_bench.experiments.timeline.view.cells import origin_notes, timelines_json, timelines_of
from s2a_bench.experiments.timeline.view.figures import timeline_figures
from s2a_bench.experiments.timeline.watch import Scene
from s2a_bench.harness.feed import RequestFeed
from s2a_bench.harness.timelines.config import PlanRequests
from s2a_bench.harness.timelines.link import PlanPrompt, write_prompts
from s2a_bench.harness.timelines.policies import prior_of
from s2a_bench.inference import EngineConfig
from s2a_bench.inference.replay import ReplayEngine
from s2a_bench.policy import Plans
from s2a_bench.policy.conformal import TrackedPolicy
from s2a_bench.store.requests import SKILLS
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.trace import Trace
from s2a_bench.transport.loopback.in_process import LoopbackClient
from s2a_bench.types import Frame, Request, Token
from tests.made_runs import SCHEMA

THREE = ("naive", "wait-then-act", "stream-to-act")


class Watched(NullProgress):
    """Looks at every scene and keeps it."""

    folder: Path

    def __init__(self) -> None:
        self.scenes: list[Scene] = []

    def watch(self, scene: Scene) -> AbstractContextManager[None]:
        self.scenes.append(scene)
        return nullcontext()


@pytest.fixture
def config(fast_board: str) -> TimelineLive:
    """Eight household skills of 30 ms each, written by a replay: naive has to wait for every one of them."""
    requests = PlanRequests(
        transports="loopback", engine=EngineConfig(name="replay", profile=fast_board), size=(64, 48), timeout_s=30.0
    )
    return TimelineLive(requests=requests, t_nom_s=(0.03,))


def requesting(config: TimelineLive, **changes: Any) -> TimelineLive:
    return config.but(requests=config.requests.but(**changes))


def live(config: TimelineLive, output: Path) -> tuple[StoredRun, Watched]:
    view = Watched()
    return read_run(run_live(config, output / "runs", view)), view


def failed(config: TimelineLive, output: Path, error: type[BaseException], match: str = "") -> StoredRun:
    """Run, expecting an error, and return the folder that is kept."""
    view = Watched()
    with pytest.raises(error, match=match):
        run_live(config, output / "runs", view)
    return read_run(view.folder)


def dying(stream: Callable[..., Iterable[Token]], tokens: int, error: Exception) -> Callable[..., Iterator[Token]]:
    """Return a stream that breaks after so many tokens."""

    def dies(*given: object) -> Iterator[Token]:
        for token in stream(*given):
            if token.index == tokens:
                raise error
            yield token

    return dies


def outcomes(run: StoredRun) -> list[str]:
    return [execution["outcome"] for execution in run.manifest["executions"].values()]


def test_a_replay_over_loopback_is_executed_by_three_policies_at_once(config: TimelineLive, tmp_path: Path) -> None:
    run, view = live(config, tmp_path)
    assert run.manifest["state"] == "finished"
    assert outcomes(run) == ["completed"] * 3
    cells = timelines_of(run)
    assert [cell.policy for cell in cells] == list(THREE)
    _, wait, _ = cells
    assert {cell.first.mode for cell in cells} == {"live"}
    assert len({cell.first.request_id for cell in cells}) == 1
    for cell in cells:
        assert len(cell.skills) == 8
        assert all(skill.start_ns >= skill.arrival_ns for skill in cell.skills)
        assert all(later.start_ns >= skill.end_ns for skill, later in pairwise(cell.skills))
        assert all(skill.due_ns is not None and skill.start_ns >= skill.due_ns for skill in cell.skills)
        assert all(skill.end_ns > skill.start_ns for skill in cell.skills)
        assert len(cell.token_s) == 48
        np.testing.assert_allclose(cell.complete_s, cell.token_s[5::6], rtol=0, atol=1e-9)
        assert all(re.fullmatch(r"\w+\(\w+(, \w+)?\)", skill.text) for skill in cell.skills)
    assert wait.skills[0].start_ns >= wait.skills[-1].arrival_ns
    assert len({tuple(skill.text for skill in cell.skills) for cell in cells}) == 1
    assert run.manifest["live"]["transport"] == "loopback"
    assert run.manifest["start_jitter"]["starts"] == 24
    jsonschema.validate(timelines_json(run, cells), SCHEMA)
    assert run.manifest["live"]["emulated"] is True
    assert [len(scene.records) for scene in view.scenes] == [3]
    (note,) = origin_notes(run.manifest, cells)
    assert note.startswith("EMULATED tokens over loopback, parsed and executed as they arrive")
    assert list(timeline_figures(cells, ())) == ["timeline"]
    assert run.samples["warmup"].tolist() == [True, False]
    warm_ns = run.tokens["client_ns"].iloc[:48]
    assert run.manifest["prior"]["mean_s"] == pytest.approx((warm_ns.iloc[-1] - warm_ns.iloc[0]) / 47e9)


def test_plans_of_a_profile_whose_model_sees_no_picture_say_so(
    config: TimelineLive, fast_board: str, tmp_path: Path
) -> None:
    with Path(fast_board).open("a") as profile:
        profile.write('\n[model]\npictures = "not seen"\n')
    run, view = live(config, tmp_path)
    assert view.scenes[0].title.endswith(", picture not seen, emulated, replay engine")
    (note,) = origin_notes(run.manifest, timelines_of(run))
    assert note.endswith("skills only take their time. Picture not seen: the plan is not about it.")
    assert note.labels == ("emulated", "picture not seen")  # type: ignore[attr-defined]


acted: list[str] = []


def act(motion: SkillMotion) -> None:
    """Stand in for somebody's robot."""
    acted.append(str(motion.call))
    assert motion.wait()


def test_a_function_is_called_with_every_skill(config: TimelineLive, tmp_path: Path) -> None:
    acted.clear()
    run, _ = live(config.but(robot=f"call?function={__name__}:act", policies=("naive",)), tmp_path)
    (cell,) = timelines_of(run)
    assert acted == [skill.text for skill in cell.skills]
    assert len(acted) == 8
    assert f"skills are carried out by call?function={__name__}:act" in origin_notes(run.manifest, [cell])[0]


@pytest.mark.slow
def test_a_real_model_is_held_to_its_grammar_and_its_pace(
    config: TimelineLive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("S2A_BENCH_CACHE", str(tmp_path / "cache"))
    engine = EngineConfig(threads=1, pace=60.0)
    changed = requesting(config, engine=engine, transports="http", timeout_s=120.0, requests=2)
    changed = changed.but(t_nom_s=(0.05,), task="Tidy up.")
    run, _ = live(changed, tmp_path)
    assert outcomes(run) == ["completed"] * 6
    facts = [run.manifest["live"][name] for name in ("engine", "emulated", "dummy", "paced_tokens_per_s")]
    assert facts == ["llama", False, True, 60.0]
    cells = timelines_of(run)
    assert {(cell.first.emulated, cell.first.tokens_per_s, len(cell)) for cell in cells} == {(False, 60.0, 2)}
    assert (run.tokens.groupby("request_id").size() == 48).all()
    (note,) = origin_notes(run.manifest, cells)
    assert note.startswith("LIVE: real tokens over http/as-deployed, paced to 60 tokens/s (the rate is set)")
    assert note.endswith("Dummy weights: what the plan says means nothing.")
    first, second = (frame["text"].str.cat() for _, frame in run.tokens[48:].groupby("request_id"))
    assert first != second  # every plan has a seed of its own


@pytest.mark.parametrize("tokens", [0, 5, 6, 47])
def test_a_stream_that_dies_is_told_and_what_ran_is_kept(
    config: TimelineLive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tokens: int
) -> None:
    error = EngineError("the board fell off the robot")
    monkeypatch.setattr(ReplayEngine, "generate", dying(ReplayEngine.generate, tokens, error))
    run = failed(requesting(config, warmup=0), tmp_path, TransportError, "no request of loopback succeeded")
    assert run.manifest["state"] == "failed"
    assert run.samples["error"].tolist() == ["RequestFailed: the board fell off the robot"]
    executions = run.manifest["executions"]
    codes = [warning["code"] for warning in run.manifest["warnings"]]
    assert outcomes(run) == ["stream-error"] * 3
    assert codes.count("plan-stream-error") == 1
    assert {found["arrived"] for found in executions.values()} == {tokens // 6}
    assert next(found["started"] for name, found in executions.items() if "wait-then-act" in name) == 0
    assert len(run.table(TIMELINES)) == len([found for found in executions.values() if found["started"]])
    assert len(run.tokens) == tokens


def test_a_server_that_dies_ends_the_run_but_not_in_the_middle_of_a_skill(
    config: TimelineLive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = ServerDied("the server (pid 7) died, killed by signal 9")
    monkeypatch.setattr(LoopbackClient, "request", dying(LoopbackClient.request, 20, error))
    run = failed(requesting(config, warmup=0).but(t_nom_s=(2.0,)), tmp_path, ServerDied, "pid 7")
    assert run.manifest["state"] == "failed"
    assert {*outcomes(run)} == {"stream-error"}
    skills = run.table(SKILLS)
    assert len(skills[skills["cell"].str.endswith("/naive")]) == 1
    assert (skills["end_ns"] - skills["start_ns"] >= 1.6e9 - 1e6).all()


def test_a_camera_that_breaks_ends_the_run_and_not_the_executors(
    config: TimelineLive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = RequestFeed.capture
    frames = iter(range(9))

    def breaks(self: RequestFeed, trace: Trace) -> Frame:
        if next(frames):
            raise SourceError("the camera was pulled out")
        return whole(self, trace)

    monkeypatch.setattr(RequestFeed, "capture", breaks)
    assert {*outcomes(failed(config, tmp_path, SourceError, "pulled out"))} == {"stream-error"}


def test_an_interruption_aborts_the_robots_and_keeps_what_ran(config: TimelineLive, tmp_path: Path) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    class Impatient(Watched):
        def watch(self, scene: Scene) -> AbstractContextManager[None]:
            signal.setitimer(signal.ITIMER_REAL, 0.5)
            return super().watch(scene)

    view = Impatient()
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_live(config.but(t_nom_s=(100.0,)), tmp_path / "runs", view)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    run = read_run(view.folder)
    assert run.manifest["state"] == "interrupted"
    assert {*outcomes(run)} == {"aborted"}
    assert all(scene.records[0].outcome == "aborted" for scene in view.scenes)


def test_a_board_is_played_in_real_time(fast_board: str, tmp_path: Path) -> None:
    policies = (*THREE, "s2a-clairvoyant")
    played = TimelineRealTime(profiles=(fast_board,), tokens_per_skill=(6, 2), t_nom_s=(0.03,), policies=policies)
    run = read_run(run_real_time(played, tmp_path / "runs", Watched()))
    cells = timelines_of(run)
    assert [(cell.first.tokens_per_skill, cell.policy) for cell in cells] == [*product((6, 2), policies)]
    assert {(cell.first.mode, cell.first.emulated) for cell in cells} == {("real-time", True)}
    naive, wait, _, clairvoyant = cells[:4]
    # t_i = .05 + i / 20 s at least: a real clock is never early.
    assert (naive.complete_s >= 0.05 + np.arange(1, 9) / 20 - 1e-6).all()
    assert clairvoyant.mean("start_s") >= 0.05 + 0.4 - 7 * 0.03 - 1e-6  # type: ignore[operator]
    assert wait.skills[0].start_ns >= wait.skills[-1].arrival_ns
    assert run.manifest["configuration"]["time"] == "real-time"
    assert run.manifest["start_jitter"]["starts"] == 64
    assert any("EMULATED, executed in real time" in note for note in origin_notes(run.manifest, cells))
    jsonschema.validate(timelines_json(run, cells), SCHEMA)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policies": ("s2a-clairvoyant",)}, "s2a-clairvoyant needs to know when every skill will arrive"),
        ({"skills": "juggling"}, "`skills`: 'juggling' is not one of"),
        ({"epsilon": 0.05}, "`epsilon`: no policy is calibrated before a live run; it needs `track`"),
        ({"requests": {"requests": 0}}, "`requests`: 0 should be greater than or equal to 1"),
        ({"robot": "call", "policies": ("naive",)}, "`robot`: call: function = '' should look like module:name"),
        ({"robot": "ros"}, "`robot`: ros follows one policy at a time"),
        ({"tokens_per_skill": (4,)}, "`engine` replay writes plans of the household skills in 6 tokens a skill"),
        ({"skills": "driving"}, "`engine` replay writes plans of the household skills in 6 tokens a skill"),
        ({"requests": {"transports": "http,ros"}}, "`transport`: one stream is followed, not http"),
    ],
)
def test_what_makes_no_sense_is_named(config: TimelineLive, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        config.but(**fields)
    assert message in str(error.value)


def test_the_prior_is_learned_from_warm_ups_and_else_from_the_pace() -> None:
    assert prior_of([], None) is None
    assert prior_of([[5]], None) is None
    paced = prior_of([], 5.0)
    assert paced is not None
    assert paced.mean_s == 0.2
    learned = prior_of([[0, 10**8, 3 * 10**8], [0, 3 * 10**8]], 5.0)
    assert learned is not None
    assert learned.mean_s == pytest.approx(0.2)
    assert learned.token_cv == pytest.approx(np.std([0.1, 0.2, 0.3], ddof=1) / 0.2)


def test_a_prior_knows_bursts_that_single_gaps_hide() -> None:
    slow_then_fast = np.cumsum([0.0, *[0.3] * 8, *[0.1] * 8]) * 1e9
    alternating = np.cumsum([0.0, *[0.3, 0.1] * 8]) * 1e9
    burst, even = (prior_of([times.astype(int).tolist()], None) for times in (slow_then_fast, alternating))
    assert burst is not None
    assert even is not None
    assert even.token_cv == pytest.approx(np.std([0.3, 0.1] * 8, ddof=1) / 0.2)
    assert burst.token_cv > 1.9 * even.token_cv  # four blocks of four: 1.2, 1.2, .4, .4 s


def test_skills_keep_their_own_durations_unless_they_are_given(config: TimelineLive) -> None:
    def prompt(config: TimelineLive) -> PlanPrompt:
        (prompt,) = write_prompts(prompt_plan(config), None, exact=True)
        return prompt

    own = prompt(config.but(t_nom_s=()))
    times = [call.skill.durations.nominal_s for call in own.skills.calls]
    assert own.shape.expected.nominal_s == pytest.approx(np.mean(times))
    assert own.shape.expected_cv == pytest.approx(np.std(times) / np.mean(times))
    given = prompt(config)
    assert (given.shape.expected.nominal_s, given.shape.expected_cv) == (pytest.approx(0.03), 0.0)
    assert given.shape.expected.most_s == pytest.approx(0.045)
    assert "Output exactly 8 of them." in given.prompt
    assert (bool(given.grammar), given.max_tokens) == (True, 48)
    assert prompt(config.but(no_grammar=True)).grammar == ""


def test_tokens_that_come_slower_than_in_the_warm_ups_are_named(
    config: TimelineLive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate = ReplayEngine.generate
    answers = iter(range(10))

    def paced(self: ReplayEngine, request: Request) -> Iterator[Token]:
        late = next(answers) >= 5
        for token in generate(self, request):
            if late:
                time.sleep(0.03)
            yield token

    monkeypatch.setattr(ReplayEngine, "generate", paced)
    run, _ = live(requesting(config, warmup=5, requests=5).but(policies=("naive",), n_skills=(2,)), tmp_path)
    (found,) = [each["message"] for each in run.manifest["warnings"] if each["code"] == "delays-changed"]
    assert found.startswith("loopback: delays changed since the calibration")


@pytest.fixture
def taught(monkeypatch: pytest.MonkeyPatch) -> list[TrackedPolicy]:
    """Every `TrackedPolicy` that learned from a plan, in order."""
    whole = TrackedPolicy.learn
    found: list[TrackedPolicy] = []

    def learn(self: TrackedPolicy, plan: Plans, *, stalled: bool) -> None:
        whole(self, plan, stalled=stalled)
        found.append(self)

    monkeypatch.setattr(TrackedPolicy, "learn", learn)
    return found


def test_lambda_is_followed_live_by_each_policy(
    config: TimelineLive, taught: list[TrackedPolicy], tmp_path: Path
) -> None:
    policies = ("stream-to-act", "stream-to-act?detect=True", "naive")
    live(requesting(config, requests=2).but(policies=policies, track=True, n_skills=(3,)), tmp_path)
    assert [each.base.detect for each in taught] == [False, True] * 2
    assert taught[:2] == taught[2:]
    for each in taught[:2]:
        assert each.tracker.level != each.tracker.epsilon == 0.01


def test_lambda_is_followed_in_real_time(fast_board: str, taught: list[TrackedPolicy], tmp_path: Path) -> None:
    config = TimelineRealTime(
        profiles=(fast_board,),
        tokens_per_skill=(2,),
        n_skills=(4,),
        t_nom_s=(0.01,),
        jitter="lognormal:cv=0.3",
        policies=("stream-to-act",),
        plans=2,
        track=True,
    )
    run = read_run(run_real_time(config, tmp_path / "runs", Watched()))
    assert len(run.table(TIMELINES)) == 2
    first, again = taught
    assert first is again
    assert first.tracker.level != first.tracker.epsilon
