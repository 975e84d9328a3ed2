"""The paper's claims, judged by runs of which it is known what they must say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.run import run_boundary
from s2a_bench.experiments.ccrb.config import CcrbConfig
from s2a_bench.experiments.ccrb.rows import ROLLOUTS
from s2a_bench.experiments.ccrb.run import run_ccrb
from s2a_bench.experiments.timeline.config import TimelineConfig
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.report.claims.checks import CLAIMS, is_board
from s2a_bench.report.claims.claim import CONFIRMED, NO_RUN, REFUTED, UNTESTABLE
from s2a_bench.report.claims.verdicts import Judged, claim_table, judge_claims
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import Run, RunWriter, read_run
from s2a_bench.testing import NullProgress

MakeRun = Callable[..., Run]
MakeRow = Callable[..., SampleRow]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}
EVEN: dict[str, dict[str, float]] = {
    "http/as-deployed": {"base64_encode": 65.7, "inference": 5, "return": 0},
    "ros/topic": {"convert": 10, "inference": 5, "return": 0},
}


def claim_of(text: str, *runs: Run) -> Judged:
    (found,) = [judged for judged in judge_claims(runs) if text in judged.claim.text]
    return found


@pytest.fixture(scope="module")
def timelines(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(run_timeline(TimelineConfig(), tmp_path_factory.mktemp("timeline"), NullProgress()))


@pytest.fixture(scope="module")
def ccrb(tmp_path_factory: pytest.TempPathFactory) -> Run:
    config = CcrbConfig(phase=True, phase_points=(7, 5))
    return read_run(run_ccrb(config, tmp_path_factory.mktemp("ccrb"), NullProgress()))


def test_without_runs_each_claim_says_what_to_run() -> None:
    judged = judge_claims([])
    assert len(judged) == len(CLAIMS) > 20
    assert {each.verdict for each in judged} == {NO_RUN}
    assert all(each.evidence == (f"Run: {each.claim.run}",) for each in judged)
    assert all(each.claim.run.startswith(f"s2a-bench {each.claim.command}") for each in judged)
    table = claim_table(judged)
    assert len(table.rows) == len(CLAIMS)
    assert {row[2] for row in table.rows} == {NO_RUN}


@pytest.mark.parametrize(("http_ms", "verdict"), [(65.7, CONFIRMED), (3.0, REFUTED), (10.0, REFUTED)])
def test_http_is_slower_only_where_the_interval_says_so(make_run: MakeRun, http_ms: float, verdict: str) -> None:
    cells = {**EVEN, "http/as-deployed": {"base64_encode": http_ms, "inference": 5, "return": 0}}
    assert claim_of("HTTP/JSON takes longer", make_run(cells)).verdict == verdict


@pytest.mark.parametrize(
    ("environment", "http_ms", "verdict"),
    [(ORIN, 65.7, CONFIRMED), (ORIN, 30.0, REFUTED), (RTX, 65.7, UNTESTABLE), ({}, 65.7, UNTESTABLE)],
)
def test_the_ratio_can_be_judged_on_the_papers_board_only(
    make_run: MakeRun, environment: dict[str, Any], http_ms: float, verdict: str
) -> None:
    cells = {**EVEN, "http/as-deployed": {"base64_encode": http_ms, "inference": 5, "return": 0}}
    judged = claim_of("6.57 times", make_run(cells, manifest={"environment": environment}))
    assert judged.verdict == verdict
    assert "The paper: 6.57" in judged.evidence[0]


def test_one_sample_is_too_few_for_a_verdict(make_run: MakeRun) -> None:
    assert claim_of("HTTP/JSON takes longer", make_run(EVEN, n=1)).verdict == UNTESTABLE


def test_json_pack_and_post_are_merged_as_in_figure_6(make_run: MakeRun) -> None:
    stages = {"convert": 30, "base64_encode": 5, "json_pack": 20, "network": 25, "inference": 100, "return": 20}
    run = make_run({**EVEN, "http/as-deployed": stages}, spread=0)
    judged = claim_of("Most HTTP overhead", run)
    assert judged.verdict == REFUTED
    assert "Base64 5%, JSON pack and HTTP POST merged 45% (the network alone 25%)" in judged.evidence[0]
    assert "together 50%, without the network 25%" in judged.evidence[0]
    stages["json_pack"] = 21
    assert claim_of("Most HTTP overhead", make_run({**EVEN, "http/as-deployed": stages}, spread=0)).verdict == CONFIRMED


def test_ros_is_dominated_by_conversions_or_not(make_run: MakeRun) -> None:
    assert claim_of("colour conversions", make_run(EVEN)).verdict == CONFIRMED
    other = {**EVEN, "ros/topic": {"convert": 4, "network": 6, "inference": 5, "return": 0}}
    judged = claim_of("colour conversions", make_run(other, spread=0))
    assert judged.verdict == REFUTED
    assert "take 40%" in judged.evidence[0]
    assert "longest stage is network with 60%" in judged.evidence[0]


@pytest.mark.parametrize(
    ("plain", "coded", "verdict"),
    [(90_000, 120_000, CONFIRMED), (90_000, 160_000, REFUTED), (900, 1_200, UNTESTABLE), (90_000, 90_000, REFUTED)],
)
def test_base64_is_judged_by_what_the_bodies_weigh(
    make_run: MakeRun, make_row: MakeRow, plain: int, coded: int, verdict: str
) -> None:
    sent = {"http/as-deployed": coded, "http/binary": plain}
    rows = [make_row(name, EVEN["ros/topic"], 1, payload_bytes=size, request_id=name) for name, size in sent.items()]
    assert claim_of("1.3333", make_run({}, extra=tuple(rows))).verdict == verdict
    assert claim_of("1.3333", make_run(EVEN)).verdict == NO_RUN  # no binary cell to compare with


@pytest.fixture
def spoken(tmp_path: Path, make_row: MakeRow) -> MakeRun:
    """Make a throughput run whose engine generates at a rate."""

    def made(rate: float, *, engine: str = "llama", **manifest: Any) -> Run:
        with RunWriter.create(tmp_path, "throughput", manifest) as run:
            for block in range(3):
                facts = {"predicted_n": 48.0, "predicted_ms": 48e3 / rate}
                row = make_row("in-process", EVEN["ros/topic"], block, engine=engine, facts=facts, n_tokens=2)
                run.sample(replace(row, pipeline="loopback"))
                run.tokens(TokenRow(row.request_id, row.cell, i, i, "x", None, 10**10 + i * 10**7) for i in range(2))
        return read_run(run.path)

    return made


@pytest.mark.parametrize(
    ("rate", "facts", "verdict"),
    [
        (34.0, {"environment": RTX}, CONFIRMED),
        (50.0, {"environment": RTX}, REFUTED),
        (34.2, {"environment": ORIN}, UNTESTABLE),
        (34.2, {"environment": RTX, "model": {"dummy": True}}, UNTESTABLE),
        (34.2, {"environment": RTX, "engine": "replay"}, UNTESTABLE),
    ],
)
def test_table_ii_is_judged_by_a_real_model_on_that_board(
    spoken: MakeRun, rate: float, facts: dict[str, Any], verdict: str
) -> None:
    judged = claim_of("RTX 4080: 34.2", spoken(rate, **facts))
    assert judged.verdict == verdict
    assert f"{rate:.1f}" in judged.evidence[0]
    assert ("EMULATED" in judged.evidence[0]) == ("engine" in facts)


@pytest.mark.parametrize(
    ("environment", "name", "same"),
    [
        (ORIN, "Jetson AGX Orin", True),
        (ORIN, "Jetson Orin Nano", False),
        ({"board": "NVIDIA Jetson Orin Nano Super Developer Kit"}, "Jetson AGX Orin", False),
        (RTX, "RTX 4080", True),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 4080 SUPER"}]}, "RTX 4080", False),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 4080 Laptop GPU"}]}, "RTX 4080", False),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 40800"}]}, "RTX 4080", False),
        ({}, "RTX 4080", False),
    ],
)
def test_a_board_is_known_by_its_whole_name(
    make_run: MakeRun, environment: dict[str, Any], name: str, same: bool
) -> None:
    assert is_board(make_run({}, manifest={"environment": environment}), name) == same


def test_the_timelines_of_table_ii_bear_the_papers_findings_out(timelines: Run) -> None:
    verdicts = {judged.claim.text.split(" (")[0]: judged for judged in judge_claims([timelines])}
    for text in (
        "RTX 4080: all policies run smoothly with no noticeable stalls",
        "AGX Orin: naive shows intermittent stalls",
        "AGX Orin: wait-then-act avoids stalls but ends later",
        "AGX Orin: stream-to-act eliminates stalls",
        "Orin Nano: naive exhibits frequent stop-and-go",
        "Orin Nano: stream-to-act preserves continuity from S0",
        "More tokens a skill raise naive's stalls",
        "Stream-to-act has no significant latency penalty",
    ):
        assert verdicts[text].verdict == CONFIRMED, text
        assert "EMULATED" in verdicts[text].evidence[0]
        assert "assumption" in verdicts[text].evidence[0]
    assert (
        "L = 6: 7 stalls of 1.75 s; none at L = 4, 2, 1"
        in verdicts["AGX Orin: naive shows intermittent stalls"].evidence[0]
    )


def test_fast_and_smooth_means_against_waiting_and_the_evidence_says_what_it_is_not(timelines: Run) -> None:
    fast = claim_of("preferable for fast and smooth control", timelines)
    assert fast.verdict == CONFIRMED
    assert "It never stalls. It ends 2% to 38% of wait-then-act's time earlier" in fast.evidence[0]
    assert "finishes no earlier than naive" in fast.evidence[0]


def test_what_the_paper_says_beyond_that_is_not_confirmed(timelines: Run) -> None:
    minimal = claim_of("S0 is minimal", timelines)
    assert minimal.verdict == REFUTED
    # Q_7 = 7 * 1.5 s instead of P_7 = 7 s after S0 = 78.76 s.
    assert "75.26 s instead of S0 = 78.76 s" in minimal.evidence[0]
    assert claim_of("excessive delays", timelines).verdict == REFUTED


def test_s0_is_minimal_where_nothing_can_be_stretched(tmp_path: Path) -> None:
    run = read_run(run_timeline(TimelineConfig(t_max=1.0), tmp_path, NullProgress()))
    assert claim_of("S0 is minimal", run).verdict == NO_RUN


def test_timelines_at_other_rates_say_nothing_of_the_papers_boards(tmp_path: Path) -> None:
    run = read_run(run_timeline(TimelineConfig(profiles=(), rates=(9.0,)), tmp_path, NullProgress()))
    assert claim_of("AGX Orin: naive", run).verdict == NO_RUN
    assert claim_of("no significant latency penalty", run).verdict == CONFIRMED


def test_a_stall_of_stream_to_act_refutes_its_claim(timelines: Run) -> None:
    rows = timelines.table(TIMELINES).copy()
    mine = (rows["policy"] == "stream-to-act") & (rows["board"] == "jetson-orin-nano")
    rows.loc[mine, "stalls"] = 2
    rows.loc[mine, "stall_ns"] = 3_000_000_000
    worse = replace(timelines, tables=timelines.tables | {"timelines": rows})
    judged = claim_of("Orin Nano: stream-to-act", worse)
    assert judged.verdict == REFUTED
    assert "stream-to-act at L = 6: 2 stalls of 3.00 s" in judged.evidence[0]
    # A run that refutes outweighs one that confirms, and both are told.
    both = claim_of("Orin Nano: stream-to-act", timelines, worse)
    assert both.verdict == REFUTED
    assert [CONFIRMED in both.evidence[0], REFUTED in both.evidence[1]] == [True, True]


def test_the_boundary_has_a_safe_side_and_one_that_is_not_always_unsafe(tmp_path: Path) -> None:
    run = read_run(run_boundary(BoundaryConfig(), tmp_path, NullProgress()))
    assert claim_of("suffices", run).verdict == CONFIRMED
    below = claim_of("Below R", run)
    assert below.verdict == REFUTED
    assert "the line is R = L/T_nom" in below.evidence[0]
    jitter = BoundaryConfig(jitter="lognormal:cv=0.2", plans=50, points=10)
    assert claim_of("Below R", read_run(run_boundary(jitter, tmp_path, NullProgress()))).verdict == UNTESTABLE


def test_where_skills_cannot_end_early_the_papers_line_is_right(tmp_path: Path) -> None:
    run = read_run(run_boundary(BoundaryConfig(t_min=1.0), tmp_path, NullProgress()))
    assert claim_of("Below R", run).verdict == CONFIRMED


def test_the_operating_point_bears_the_outcomes_out_and_the_diagram_does_not(ccrb: Run) -> None:
    for text in ("hit from behind", "hits the car ahead", "hits nobody"):
        judged = claim_of(f"{text}", ccrb)
        assert judged.verdict == CONFIRMED
        assert "one operating point" in judged.evidence[0]
        assert "careful follower" in judged.evidence[0]
    assert claim_of("Waiting is less safe", ccrb).verdict == CONFIRMED
    naive = claim_of("Naive is less safe", ccrb)
    assert naive.verdict == REFUTED
    assert all(gap in naive.evidence[0] for gap in ("stop", "coast", "hold", "cruise"))


def test_another_outcome_refutes(ccrb: Run) -> None:
    rows = ccrb.table(ROLLOUTS).copy()
    rows.loc[(rows["study"] == "point") & (rows["policy"] == "naive"), "outcome"] = "none"
    assert claim_of("hit from behind", replace(ccrb, tables=ccrb.tables | {"rollouts": rows})).verdict == REFUTED


def test_without_a_phase_diagram_nothing_is_generic(ccrb: Run) -> None:
    rows = ccrb.table(ROLLOUTS)
    point = replace(ccrb, tables=ccrb.tables | {"rollouts": rows[rows["study"] == "point"]})
    judged = claim_of("Naive is less safe", point)
    assert judged.verdict == UNTESTABLE
    assert "--phase" in judged.evidence[0]
