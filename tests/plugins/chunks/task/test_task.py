"""The experiment task: its rows, what it says of the latency that is borne, and live what is computed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from s2a_bench.errors import EngineError, RobotError, S2AError, UsageError
from s2a_bench.experiments.cells import Cells
from s2a_bench.plugins.chunks.latencies import sources
from s2a_bench.plugins.chunks.modes import ControlSetting, Rounding, mode
from s2a_bench.plugins.chunks.task.config import TaskLive, TaskVirtual
from s2a_bench.plugins.chunks.task.live import run_live
from s2a_bench.plugins.chunks.task.rows import EPISODES, EpisodeRow, TaskCell, _lost, task_cells
from s2a_bench.plugins.chunks.task.view import borne, show, task_sentences
from s2a_bench.plugins.chunks.task.virtual import TaskCase, run_virtual
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from tests.plugins.chunks.task.worlds import HERE

POLE = "gym?env=CartPole-v1&picture=none&success=survival"
PENDULUM = "gym?env=Pendulum-v1&picture=none&success=return&least=-1e9"
LOOKS = f"gym?env={HERE}:Pictures-v0&success=survival&max_episode_steps=25"
OUTCOME = ["seed", "success", "reward", "ticks", "stall_ticks", "age_ticks", "path", "jerk"]
SHARED: dict[str, Any] = {
    "robot": f"{POLE}&max_episode_steps=100",
    "latency": ["0", "20", "300"],
    "modes": ["replace?execute=2", "sync?execute=1"],
    "horizon": 4,
    "seed": 7,
}
TRIES = 5


@pytest.fixture(autouse=True)
def in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "tmp_path" in request.fixturenames:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})


def ran(folder: Path, policy: str = "balance", **options: Any) -> StoredRun:
    engine, horizon = {"name": f"call?function={HERE}:{policy}"}, options.get("horizon", 16)
    given = {"robot": POLE, "engine": engine, "prompt": str(horizon), "episodes": 3, "horizon": horizon}
    return read_run(run_virtual(TaskVirtual(**given | options), folder, NullProgress()))


def acted(folder: Path, transport: str, policy: str, **options: Any) -> StoredRun:
    requests = {
        "transports": transport,
        "engine": {"name": f"call?function={HERE}:{policy}"},
        "prompt": str(options["horizon"]),
        "warmup": 1,
        "size": "64x48",
    }
    folder.mkdir(exist_ok=True)
    return read_run(run_live(TaskLive(**{"requests": requests, "episodes": 2, **options}), folder, NullProgress()))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    """Latencies that a cart-pole bears, and does not; on all cores."""
    return ran(tmp_path_factory.mktemp("task"), episodes=40, **SHARED)


def test_every_mode_has_the_same_episodes_under_every_latency(run: StoredRun) -> None:
    rows = run.table(EPISODES)
    assert rows["seed"].tolist() == [seed for seed in range(7, 47) for _ in range(6)]
    cells = list(product(SHARED["latency"], SHARED["modes"]))
    assert list(zip(rows["latency"], rows["mode"], strict=True)) == cells * 40
    assert rows["cell"].tolist() == [f"{name} @ {latency}" for latency, name in cells] * 40
    assert rows["success"].tolist() == (rows["ticks"] == 100).tolist()
    assert (rows["reward"] == rows["ticks"]).all()
    assert rows["duration_s"].tolist() == pytest.approx(rows["ticks"] * 0.02)
    assert rows["slower"].isna().all()


def test_one_process_finds_what_several_do(run: StoredRun, tmp_path: Path) -> None:
    theirs, ours = run.table(EPISODES), ran(tmp_path, **SHARED).table(EPISODES)  # of fewer episodes
    pd.testing.assert_frame_equal(ours, theirs[: len(ours)])


def test_its_numbers_are_of_a_policy_in_virtual_time(run: StoredRun) -> None:
    assert set(run.table(EPISODES)["provenance"]) == {"call/unknown/emulated/clock-virtual"}
    assert run.origins.of("sync?execute=1 @ 20").profile == "20"
    robot, settings = run.manifest["robot"], run.manifest["configuration"]
    assert (robot["robot"], robot["env"], robot["period"]) == ("gym", "CartPole-v1", "20 ms, of tau")
    assert (settings["period_ns"], settings["live"]) == (20_000_000, False)


def test_what_it_says_is_what_its_rows_hold(run: StoredRun) -> None:
    successes = run.table(EPISODES).groupby(["mode", "latency"])["success"].sum().to_dict()
    cells = task_cells(Cells.of(run, EPISODES))
    assert {(cell.mode, cell.latency): cell.successes for cell in cells} == successes
    assert [(cell.mode, cell.latency) for cell in cells] == list(product(SHARED["modes"], SHARED["latency"]))
    assert [cell.successes for cell in cells] == [40, 40, 0] * 2
    within = "within 10% of the success without latency, at 95 %; more is lost at 300 ms: 0% [0, 9] succeed."
    assert list(show(run).sentences) == [f"{name}: bears 20 ms: {within}" for name in SHARED["modes"]]


@pytest.mark.parametrize("rounding", ["floor", "ceil"])
def test_the_ticks_of_an_episode_are_those_of_its_mode_s_arrays(tmp_path: Path, rounding: Rounding) -> None:
    options: dict[str, Any] = {"robot": PENDULUM, "latency": "0,70,180", "rounding": rounding, "horizon": 10}
    asked = ["sync", "queue?trigger=2", "replace?execute=3", "replace?execute=1&under_way=many&assumed=0"]
    asked += ["streamed?gap_s=.02", "streamed?gap_s=.1", "streamed?gap_s=.1&start=naive"]
    setting = ControlSetting(50_000_000, 10, rounding)
    rows = ran(tmp_path, "swing", modes=asked, steps=73, episodes=1, **options).table(EPISODES)
    assert len(rows) == 3 * len(asked)
    for row in rows.to_dict("records"):
        made = mode(row["mode"])
        ticks = made.ticks(np.full(99, int(row["latency"]) * 1_000_000), setting)
        assert row["ticks"] == 73
        assert row["stall_ticks"] == ticks.stalled[:73].sum(), row["cell"]
        assert row["age_ticks"] == pytest.approx(ticks.age[:73][ticks.chunk[:73] >= 0].mean()), row["cell"]
        assert row["latency_s"] == pytest.approx(int(row["latency"]) / 1e3 + 9 * made.gap_ns / 1e9)


def case(written: str, name: str = "sync", seed: int = 0) -> TaskCase:
    (source,) = sources(written, 1)
    nothing: Any = None
    return TaskCase(nothing, nothing, "", name, nothing, nothing, source, 1, seed)


def test_a_recording_is_replayed_from_another_place_in_every_episode(tmp_path: Path) -> None:
    file = tmp_path / "latencies.csv"
    file.write_text("latency_ms\n" + "\n".join(map(str, range(100, 200))))
    played = [[ns // 10**6 for ns in islice(case(str(file)).latencies_ns(seed), 250)] for seed in range(4)]
    for each in played:
        assert each[:100] == [100 + (each[0] + turn) % 100 for turn in range(100)]
        assert each[100:] == (each * 2)[:150]
    assert len({each[0] for each in played}) > 1
    rows = ran(tmp_path, latency=str(file), modes="sync,queue", steps=10).table(EPISODES)  # one request an episode
    assert [round(each * 1e3) for each in rows["latency_s"]] == [each[0] for each in played[:3] for _ in "mq"]


def test_drawn_latencies_are_those_of_the_seed_in_every_mode(tmp_path: Path) -> None:
    written = "lognormal:mean_ms=50,cv=.5"
    drawn = [list(islice(case(written).latencies_ns(seed), 600)) for seed in range(3)]
    assert drawn == [list(islice(case(written, "queue").latencies_ns(seed), 600)) for seed in range(3)]
    assert drawn[0] != drawn[1]
    assert drawn[0] != list(islice(case(written, seed=1).latencies_ns(0), 600))
    assert np.mean(drawn) / 1e6 == pytest.approx(50, rel=0.05)
    run = ran(tmp_path, latency=written, modes="sync,queue", steps=5)
    assert run.table(EPISODES)["latency_s"].tolist() == [each[0] / 1e9 for each in drawn for _ in "mq"]
    assert [sentence.partition(",")[0] for sentence in show(run).sentences] == [
        "queue at lognormal:mean_ms=50",
        "sync at lognormal:mean_ms=50",
    ]


def cell(latency: str, low: float | None = 0.0, high: float | None = 0.0, **more: Any) -> TaskCell:
    means = {"reward": 1.0, "duration_s": 1.0, "stall_ticks": 0, "age_ticks": 1.0, "path": 0, "jerk": 0, "slower": None}
    successes = {"episodes": 50, "successes": 40, "success": 0.8, "success_low": 0.66, "success_high": 0.9}
    latency_s = float(latency) / 1e3 if latency.isdecimal() else 0.05
    names = {"cell": f"sync @ {latency}", "mode": "sync", "latency": latency, "latency_s": latency_s}
    return TaskCell(**{**names, **successes, **means, "lost": low, "lost_low": low, "lost_high": high, **more})


@pytest.mark.parametrize(
    ("judged", "says"),
    [
        (
            [cell("50", high=0.1), cell("100", 0.11, 0.3)],
            "bears 50 ms: {}; more is lost at 100 ms: 80% [66, 90] succeed",
        ),
        (
            [cell("50", high=0.1), cell("100", 0.1, 0.3)],
            "bears 50 ms: {}; 50 episodes leave it undecided at 100 ms: 80%",
        ),
        ([cell("50", -0.1, 0.0), cell("100", 0, 0.1)], "bears 100 ms: {}; nothing longer was tried"),
        ([cell("50", 0.2, 0.3)], "more is lost at 50 ms: 80% [66, 90] succeed"),
        ([cell("50"), cell("100", 0, 0.2), cell("200")], "bears 50 ms: {}; 50 episodes leave it undecided at 100 ms"),
    ],
)
def test_a_mode_bears_the_latencies_before_the_first_that_may_cost_more_than_the_margin(
    judged: Sequence[TaskCell], says: str
) -> None:
    assert borne(judged, 0.1).startswith(says.format("within 10% of the success without latency, at 95 %"))


def test_only_latencies_of_one_number_are_judged_and_only_against_none() -> None:
    drawn = cell("normal:mean_ms=50,cv=1", 0.5, 0.6)
    assert list(task_sentences([cell("0"), cell("100"), drawn], 0.2)) == [
        "sync: bears 100 ms: within 20% of the success without latency, at 95 %; nothing longer was tried.",
        "sync at normal:mean_ms=50,cv=1, 50.0 ms: 80% [66, 90] of 50 succeed.",
    ]
    alone = cell("100", None, None)
    assert list(task_sentences([alone], 0.2)) == ["sync: no latency is judged without --latency 0."]
    assert list(task_sentences([replace(drawn, lost_high=None)], 0.2)) == [
        "sync at normal:mean_ms=50,cv=1, 50.0 ms: 80% [66, 90] of 50 succeed."
    ]


def ended(latency: str, *successes: bool) -> list[EpisodeRow]:
    numbers = {"reward": 1.0, "duration_s": 1.0, "ticks": 9, "stall_ticks": 0, "age_ticks": 1.0, "path": 0, "jerk": 0}
    names = {"cell": f"sync @ {latency}", "mode": "sync", "latency": latency, "slower": None}
    rows = enumerate(successes)
    return [EpisodeRow(**names, **numbers, seed=at, latency_s=float(latency) / 1e3, success=is_) for at, is_ in rows]  # type: ignore[arg-type]


@pytest.mark.parametrize(("lost", "won"), [(0, 0), (3, 0), (2, 3), (7, 1), (0, 12), (12, 0)])
def test_the_intervals_are_those_of_clopper_and_pearson(lost: int, won: int) -> None:
    both = 12 - lost - won
    without = ended("0", *[True] * both, *[True] * lost, *[False] * won)
    here = ended("50", *[True] * both, *[False] * lost, *[True] * won)
    first, last = task_cells(Cells(pd.DataFrame(here + without), EpisodeRow, Origins(Provenance())))
    exact = [stats.binomtest(count, 12).proportion_ci(method="exact") for count in (both + won, lost, won)]
    assert (first.lost, last.episodes, last.successes, last.success) == (None, 12, both + won, (both + won) / 12)
    assert (last.success_low, last.success_high) == pytest.approx((exact[0].low, exact[0].high))
    assert last.lost == pytest.approx((lost - won) / 12)
    assert last.lost_low == pytest.approx(exact[1].low - exact[2].high)
    assert last.lost_high == pytest.approx(exact[1].high - exact[2].low)


@pytest.mark.parametrize("count", [5, 20])
def test_each_bound_of_what_is_lost_holds_with_95_percent(count: int) -> None:
    """By enumeration of all outcomes, for shares on a grid."""
    seen = [(lost, won, count - lost - won) for lost in range(count + 1) for won in range(count + 1 - lost)]
    kinds: tuple[tuple[bool | None, bool], ...] = ((True, False), (False, True), (True, True))
    ends = [_lost([kind for kind, times in zip(kinds, each, strict=True) for _ in range(times)]) for each in seen]
    low, high = (np.array([end[name] for end in ends]) for name in ("lost_low", "lost_high"))
    held = []
    for loses, wins in product(range(21), repeat=2):
        if loses + wins <= 20:
            chance = stats.multinomial(count, np.array([loses, wins, 20 - loses - wins]) / 20).pmf(seen)
            truth = (loses - wins) / 20
            held += [chance[low <= truth + 1e-9].sum(), chance[high >= truth - 1e-9].sum()]
    assert len(held) == 2 * 231
    assert 0.95 <= min(held) < 1


def test_a_mode_that_fails_without_latency_bears_none() -> None:
    fails = {"successes": 0, "success": 0.0, "success_low": 0.0, "success_high": 0.07}
    cells = [cell(latency, 0.0, 0.07, **fails) for latency in ("0", "100")]
    assert not any("bears 100 ms" in sentence for sentence in task_sentences(cells, 0.1))


def test_no_latency_is_none_however_it_is_written(tmp_path: Path) -> None:
    run = ran(tmp_path, latency=[0.0, 50.0], modes="sync", steps=5)
    assert {each.lost for each in task_cells(Cells.of(run, EPISODES))} == {0.0, None}


@pytest.mark.parametrize(
    ("policy", "options", "kind", "message"),
    [
        (
            "balance",
            {"prompt": "3", "horizon": 4},
            UsageError,
            "`horizon`: `engine` call?function={} answers with chunks of 3 actions, not 4; set that",
        ),
        ("broken", {}, EngineError, "call: {}: KeyError: 'gripper'"),
        (
            "swing",
            {"horizon": 2, "robot": f"gym?env={HERE}:Pictures-v0&picture=none"},
            RobotError,
            "`robot`: gym: an action of shape (1,); tests.plugins.chunks.task.worlds:Pictures-v0 takes (2,)",
        ),
        (
            "balance",
            {"robot": "gym?env=CartPole-v1&picture=none", "steps": 3},
            RobotError,
            "`robot`: gym: CartPole-v1 says nothing of success",
        ),
        ("balance", {"robot": "timed"}, UsageError, "`robot`: timed does no task; gym does"),
        ("balance", {"engine": {}}, UsageError, "`engine`: name the policy, as call?function=MODULE:NAME"),
        ("balance", {"latency": ""}, UsageError, "`latency`: name at least one"),
        (
            "balance",
            {"modes": "replace?execute=8", "horizon": 4},
            UsageError,
            "`modes`: replace: a chunk has 4 actions (`horizon`)",
        ),
    ],
)
def test_what_goes_wrong_is_one_line(
    tmp_path: Path, policy: str, options: dict[str, Any], kind: type[S2AError], message: str
) -> None:
    with pytest.raises(kind) as error:
        ran(tmp_path, policy, **{"latency": "0", "modes": "sync", **options})
    assert str(error.value).startswith(message.format(f"{HERE}:{policy}"))


@pytest.mark.parametrize("transport", ["loopback", "http/as-deployed"])
def test_live_does_what_is_computed_a_tick_late(tmp_path: Path, transport: str) -> None:
    """An answer that takes more than a tick on a busy machine is tried again."""
    options: dict[str, Any] = {"horizon": 3, "modes": "replace?execute=2", "control_hz": 20}  # half real time
    options["robot"] = f"{POLE}&max_episode_steps=25"
    computed = ran(tmp_path, latency="50", episodes=2, **options).table(EPISODES)
    for attempt in range(TRIES):
        run = acted(tmp_path / str(attempt), transport, "balance", **options)
        rows = run.table(EPISODES)
        if rows[OUTCOME].equals(computed[OUTCOME]):
            break
    assert rows[OUTCOME].to_dict() == computed[OUTCOME].to_dict()
    assert set(rows["provenance"]) == {"call/unknown/measured"}
    assert rows["cell"].tolist() == [f"replace?execute=2 @ {transport}"] * 2
    assert (rows["slower"] > 0).all()
    assert (rows["latency_s"] > 0).all()
    assert run.manifest["robot"] == ran(tmp_path, latency="0", **options).manifest["robot"]
    assert run.manifest["configuration"]["live"] is True
    sentence = next(iter(show(run).sentences))
    assert sentence.startswith(f"replace?execute=2 at {transport}, ")
    assert sentence.endswith(" ms: 100% [16, 100] of 2 succeed.")


def test_a_policy_sees_the_pictures_of_the_robot_and_the_state_beside_each(tmp_path: Path) -> None:
    rows = ran(tmp_path, "looks", robot=LOOKS, latency="0,40", horizon=1, modes="sync").table(EPISODES)
    assert rows["reward"].tolist() == [25, 23] * 3


@pytest.mark.parametrize("transport", ["loopback", "http/as-deployed"])
def test_live_the_pictures_of_the_robot_go_over_the_wire_as_they_are(tmp_path: Path, transport: str) -> None:
    rows = acted(tmp_path, transport, "looks", robot=LOOKS, horizon=1, modes="sync").table(EPISODES)
    assert rows["ticks"].tolist() == [25, 25]
    assert (rows["reward"] > 0).all()


def test_live_a_policy_that_raises_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(S2AError, match=rf"loopback .* warming up, .* call: {HERE}:broken: KeyError: 'gripper'$"):
        acted(tmp_path, "loopback", "broken", robot=POLE, horizon=1, modes="sync")
