"""The studies of the driving scenario on small grids: where the paper's ordering holds, and where it does not."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import pandas as pd
import pytest

from s2a_bench.errors import UsageError
from s2a_bench.experiments.ccrb.config import CcrbComputed
from s2a_bench.experiments.ccrb.rows import METRICS, ROLLOUTS
from s2a_bench.experiments.ccrb.run import run_ccrb, studies
from s2a_bench.experiments.ccrb.view.figures import region_of
from s2a_bench.experiments.ccrb.view.outcomes import Rollouts, Share, rate_span, share_of
from s2a_bench.experiments.ccrb.view.tables import LOOP, finding, show
from s2a_bench.plan.skillset import GAPS
from s2a_bench.scenario.ccrb.labels import MARK, NO_SCORE
from s2a_bench.scenario.ccrb.options import CcrbOptions
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress

GRID = {"phase": True, "phase_points": (21, 13)}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., StoredRun]:
    @cache
    def make(**options: Any) -> StoredRun:
        return read_run(run_ccrb(CcrbComputed(**options), tmp_path_factory.mktemp("runs"), NullProgress()))

    return make


@pytest.fixture(scope="module")
def diagram(made: Callable[..., StoredRun]) -> StoredRun:
    """The operating point and its phase diagram."""
    return made(**GRID)


def scenes_of(run: StoredRun, gap: str = "stop", study: str = "phase") -> pd.DataFrame:
    return Rollouts.of(run).studies[study][gap]


def test_at_the_operating_point_the_papers_outcome_comes_about(made: Callable[..., StoredRun]) -> None:
    rows = made().table(ROLLOUTS).set_index("policy")
    assert rows["outcome"].to_dict() == {"naive": "rear", "wait-then-act": "front", "stream-to-act": "none"}
    assert rows["stalls"].to_dict() == {"naive": 4, "wait-then-act": 0, "stream-to-act": 0}
    starts = {"naive": 1_750_000_000, "wait-then-act": 6_750_000_000, "stream-to-act": 3_550_000_000}
    assert rows["start_ns"].to_dict() == starts
    assert rows["emulated"].all()


def test_with_full_braking_in_gaps_the_ordering_holds_for_a_band_of_rates_and_waiting_is_never_better(
    diagram: StoredRun,
) -> None:
    scenes = scenes_of(diagram)
    low, high = rate_span(scenes, 14.0) or (0.0, 0.0)
    assert 4.0 <= low <= 4.8 <= high <= 6.5
    assert share_of(scenes, "paper").value < 0.15
    assert share_of(scenes, "wait_worse").value > 0.3
    assert share_of(scenes, "wait_better").k == 0


@pytest.mark.parametrize("gap", GAPS)
def test_acting_at_once_is_better_more_often_and_the_ordering_next_to_nowhere_unless_gaps_brake(
    diagram: StoredRun, gap: str
) -> None:
    scenes = scenes_of(diagram, gap)
    assert share_of(scenes, "naive_better").k > share_of(scenes, "naive_worse").k
    if gap != "stop":
        assert rate_span(scenes, 14.0) is None
        assert share_of(scenes, "paper").value < 0.02


def test_with_the_hybrid_follower_the_operating_point_turns_round(made: Callable[..., StoredRun]) -> None:
    run = made(scenario=CcrbOptions(follower="hybrid"), **GRID)
    point = run.table(ROLLOUTS)[run.table(ROLLOUTS)["study"] == "point"].set_index("policy")
    assert point["outcome"].to_dict() == {"naive": "rear", "wait-then-act": "front", "stream-to-act": "rear"}
    assert point["rear_impact_mps"]["stream-to-act"] > point["rear_impact_mps"]["naive"] + 1
    assert rate_span(scenes_of(run), 14.0) is None
    assert share_of(scenes_of(run), "paper").value < 0.02


@pytest.mark.parametrize(("follower", "passes"), [("careful", True), ("hdm", True), ("idm", True), ("hybrid", False)])
def test_a_rear_outcome_behind_which_no_ego_is_safe_says_nothing(
    made: Callable[..., StoredRun], follower: str, passes: bool
) -> None:
    run = made(scenario=CcrbOptions(follower=follower))
    assert all(row.follower_survives is passes for row in Rollouts.of(run).point)
    table = show(run).tables["outcomes"]
    marked = [row[1] for row in table.rows if MARK in row[1]]
    assert marked == ([] if passes else [f"hit from behind {MARK}"] * 2)
    assert any("rear outcomes say nothing" in note for note in table.notes) is not passes
    assert NO_SCORE in table.notes


def test_the_diagram_says_where_the_follower_passes_its_check(
    made: Callable[..., StoredRun], diagram: StoredRun
) -> None:
    runs = diagram, made(scenario=CcrbOptions(follower="hybrid"), **GRID)
    careful, hybrid = (share_of(scenes_of(run), "survives").value for run in runs)
    assert hybrid < 0.3
    assert careful > 0.7
    rows = {row[0]: row[1] for row in show(diagram).tables["phase"].rows}
    assert rows["follower survives fast tokens"] == f"{careful:.1%}"


def test_in_random_scenarios_the_ordering_is_rare_and_waiting_is_worse(made: Callable[..., StoredRun]) -> None:
    scenes = scenes_of(made(random=150), study="random")
    assert len(scenes) == 150
    paper, worse, better = (share_of(scenes, name) for name in ("paper", "wait_worse", "wait_better"))
    assert paper.interval[1] < 0.1
    assert worse.interval[0] > better.interval[1]


def test_random_scenarios_repeat_by_their_seed() -> None:
    again = []
    for seed in (3, 3, 4):
        ((study, scenes),) = studies(CcrbComputed(random=10, seed=seed))
        assert (study, len(scenes)) == ("random", 10)
        again.append({name: values.tolist() for name, values in scenes.numbers.items()})
    assert again[0] == again[1] != again[2]


def test_what_never_stalls_comes_out_alike_with_every_gap_behaviour(diagram: StoredRun) -> None:
    columns = ["wait-then-act", "stream-to-act"]
    for gap in GAPS[1:]:
        assert scenes_of(diagram, gap)[columns].equals(scenes_of(diagram)[columns])


def test_the_findings_name_every_gap_behaviour(diagram: StoredRun) -> None:
    lines = [finding(gap, scenes_of(diagram, gap), 14.0) for gap in GAPS]
    assert [line.split(":")[0] for line in lines] == list(GAPS)
    assert "holds nowhere" in lines[GAPS.index("hold")]


def test_the_regions_of_the_diagram_cover_it_and_the_figures_can_be_drawn(diagram: StoredRun) -> None:
    scenes = scenes_of(diagram)
    named = region_of(scenes)
    assert named.count("paper") == share_of(scenes, "paper").k > 0
    assert {"wait", "nobody", "all"} <= set(named)
    figures = show(diagram).figures
    assert len(figures["phase"]().axes) == len(GAPS)
    assert len(figures["scenario"]().axes) == 9


def test_the_interval_is_clopper_pearsons() -> None:
    assert Share(0, 100).interval == pytest.approx((0.0, 1 - 0.025 ** (1 / 100)))


def test_the_deadline_makes_stream_to_act_start_earlier_where_it_must(made: Callable[..., StoredRun]) -> None:
    rows = made(ttc=True, scenario=CcrbOptions(front_gap_m=30.0)).table(ROLLOUTS).set_index("policy")
    stream, timed = rows.loc["stream-to-act"], rows.loc["s2a-ttc"]
    assert timed["deadline_ns"] < stream["start_ns"]
    assert timed["start_ns"] == pytest.approx(timed["deadline_ns"], abs=1000)
    assert not timed["late"]
    assert timed["stalls"] == 0
    assert timed["min_front_gap_m"] > stream["min_front_gap_m"] or timed["outcome"] == "none"
    close = made(ttc=True, scenario=CcrbOptions(front_gap_m=12.0, lead_decel_mps2=6.0))
    late = close.table(ROLLOUTS).set_index("policy").loc["s2a-ttc"]
    assert late["late"]
    assert late["start_ns"] == 1_750_000_000


def test_the_metrics_are_keys_of_the_cells_and_columns_of_the_tables(made: Callable[..., StoredRun]) -> None:
    run = made()
    keys = {key for cell in show(run).json()["cells"] for key in cell}
    assert METRICS.keys() - keys == set(LOOP)
    tables = show(run).tables
    assert tables["outcomes"].header[2:4] == ("start s", "stalls")
    assert tables["margins"].header[4] == "RMS jerk m/s\N{SUPERSCRIPT THREE}"
    assert tables["outcomes"].rows[0][:4] == ("naive", "hit from behind", "1.75", "4")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": {"follower": "drunk"}}, "`follower`: 'drunk' is not one of careful, hdm, idm, hybrid"),
        ({"scenario": {"gap": "panic"}}, "`gap`: 'panic' should be 'stop', 'coast', 'hold' or 'cruise'"),
        ({"scenario": {"front_gap_m": 0.0}}, "`front_gap_m`: 0.0 should be greater than 0"),
        ({"scenario": {"n_skills": 0}}, "`n_skills`: 0 should be greater than or equal to 1"),
        ({"scenario": {"t_nom_s": 0.1}}, "the plan brakes at"),
        ({"scenario": {"lane_change": True}}, "`lane_change`: .* take `simulator` embedded"),
        ({"phase_rates": (5.0, 2.0)}, "`phase_rates`: should be two numbers .*, the lower first"),
        ({"rate": 0.01}, "which is too slow to drive"),
        ({"rate": float("nan")}, "`rate`: nan should be"),
        ({"profile": "abacus"}, "'abacus' is not one of"),
        ({"policies": ("hope",)}, "'hope' is not one of"),
    ],
)
def test_what_makes_no_sense_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        CcrbComputed(**options)
