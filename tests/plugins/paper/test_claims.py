"""The paper's claims, judged by runs of which it is known what they must say, and what verdicts are made of."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from math import inf, nextafter
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.run import run_boundary
from s2a_bench.experiments.ccrb.config import CcrbComputed
from s2a_bench.experiments.ccrb.rows import ROLLOUTS
from s2a_bench.experiments.ccrb.run import run_ccrb
from s2a_bench.experiments.references import REFERENCES
from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.rows import TIMELINES
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.plugins.paper.claims import (
    CONTRADICTED,
    IDENTITY,
    REPRODUCED,
    SUPPORTED,
    UNDECIDED,
    Check,
    ClaimFinding,
    Need,
    RunPart,
    Trial,
    all_of,
    combine,
    judge,
    within,
)
from s2a_bench.plugins.paper.claims.plans import CHOSEN, PLANE, PLANS
from s2a_bench.plugins.paper.claims.requests import PAPERS_MODEL, facts_of, on_board
from s2a_bench.plugins.paper.claims.table import CLAIMS, judge_claims
from s2a_bench.provenance import Provenance
from s2a_bench.report.verdicts import ClaimVerdict, Met, Verdicts
from s2a_bench.stats import Ratio
from s2a_bench.store.requests import SampleRow
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress

MakeRun = Callable[..., StoredRun]
MakeRow = Callable[..., SampleRow]
EVEN: dict[str, dict[str, float]] = {
    "http/as-deployed": {"base64_encode": 65.7, "inference": 5, "return": 0},
    "ros/topic": {"convert": 10, "inference": 5, "return": 0},
}


def claim_of(text: str, *runs: StoredRun) -> ClaimVerdict:
    (claim,) = [claim for claim in CLAIMS if text in claim.text]
    return judge(claim, runs)


def changed(run: StoredRun, **tables: pd.DataFrame) -> StoredRun:
    """Return a run some of whose rows are others."""
    return replace(run, tables=run.tables | tables)


@pytest.fixture(scope="module")
def timelines(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    return read_run(run_timeline(TimelineComputed(), tmp_path_factory.mktemp("timeline"), NullProgress()))


@pytest.fixture(scope="module")
def ccrb(tmp_path_factory: pytest.TempPathFactory) -> StoredRun:
    config = CcrbComputed(phase=True, phase_points=(7, 5))
    return read_run(run_ccrb(config, tmp_path_factory.mktemp("ccrb"), NullProgress()))


def test_without_runs_each_claim_says_what_to_run() -> None:
    judged = judge_claims([])
    assert len(judged) == len(CLAIMS) > 20
    assert {each.verdict for each in judged} == {UNDECIDED}
    assert [each.text for each in judged] == [f"Run: {claim.trial.run}" for claim in CLAIMS]
    assert all(not each.tested and each.rule.endswith(".") for each in judged)
    assert all(claim.trial.command in EXPERIMENTS for claim in CLAIMS)
    docs = (Path(__file__).parents[3] / "docs" / "report.md").read_text(encoding="utf-8")
    sections = {part.partition("\n")[0]: " ".join(part.split()) for part in docs.split("\n### ")[1:]}
    shared = sections["Requirements that claims share"]
    for each in judged:
        section = sections[each.where]
        assert f"**{each.claim}**" in section
        assert each.rule in section
        for need in each.required.split("; "):
            assert need in section or need in shared
    table = Verdicts(REFERENCES["paper"], judged).table()
    assert len(table.rows) == len(CLAIMS)
    assert {row[3] for row in table.rows} == {UNDECIDED}
    assert [row[2] for row in table.rows] == [claim.rule for claim in CLAIMS]


@pytest.mark.parametrize(("http_ms", "verdict"), [(65.7, SUPPORTED), (3.0, CONTRADICTED), (10.0, UNDECIDED)])
def test_http_is_slower_only_where_the_interval_says_so(beside: MakeRun, http_ms: float, verdict: str) -> None:
    cells = {**EVEN, "http/as-deployed": {"base64_encode": http_ms, "inference": 5, "return": 0}}
    assert claim_of("HTTP/JSON takes longer", beside(cells)).verdict == verdict


def test_pipelines_that_never_succeeded_in_one_block_are_not_compared(beside: MakeRun) -> None:
    run = beside(EVEN, n=12)
    rows = run.samples
    odd, http = rows["block"] % 2 == 1, rows["pipeline"] == "http"
    judged = claim_of("HTTP/JSON takes longer", changed(run, samples=rows[odd == http]))
    assert not judged.tested
    assert "launches: 0 (needs 3 or more)" in judged.required


@pytest.mark.parametrize(
    ("network_ms", "pack_ms", "verdict"),
    [(5, 70, SUPPORTED), (25, 30, UNDECIDED), (25, 5, CONTRADICTED)],
)
def test_serialisation_is_judged_with_the_network_and_without(
    beside: MakeRun, network_ms: float, pack_ms: float, verdict: str
) -> None:
    rest = 95 - network_ms - pack_ms
    stages = {"convert": rest, "base64_encode": 5, "json_pack": pack_ms, "network": network_ms, "inference": 100}
    run = beside({**EVEN, "http/as-deployed": stages | {"return": 0}}, spread=0.01)
    judged = claim_of("Most HTTP overhead", run)
    assert judged.verdict == verdict
    assert re.search(rf"{network_ms + pack_ms + 5}% \[.*\] with the network", judged.evidence[0].text)
    assert re.search(rf"{pack_ms + 5}% \[.*\] without it", judged.evidence[0].text)


@pytest.mark.parametrize(
    ("convert_ms", "pack_ms", "network_ms", "verdict"),
    [
        (10, 0, 0, SUPPORTED),
        (5.4, 4.6, 0, UNDECIDED),
        (4.6, 5.4, 0, UNDECIDED),
        (4, 1, 5, UNDECIDED),  # a loaded machine: the network takes longer, the stages that compute do not
        (4, 6, 0, CONTRADICTED),
        (1, 3, 6, CONTRADICTED),
        (0, 4, 6, CONTRADICTED),
    ],
)
def test_ros_is_dominated_by_conversions_or_not(
    beside: MakeRun, convert_ms: float, pack_ms: float, network_ms: float, verdict: str
) -> None:
    times = {"convert": convert_ms, "cdr_pack": pack_ms, "network": network_ms, "inference": 5, "return": 0}
    stages = {name: ms for name, ms in times.items() if ms or name == "return"}
    judged = claim_of("colour conversions", beside({**EVEN, "ros/topic": stages}, spread=0))
    assert judged.verdict == verdict
    computing = convert_ms / (convert_ms + pack_ms)
    assert re.search(rf"take {10 * convert_ms:.0f}%.* of the whole, {computing:.0%}.* of encode", judged.text)


def bodies(make_run: MakeRun, make_row: MakeRow, plain: int, coded: int) -> StoredRun:
    """Make a run of one request over HTTP with Base64 and one without, by what they weigh."""
    sent = {"http/as-deployed": coded, "http/binary": plain}
    rows = [make_row(name, EVEN["ros/topic"], 1, payload_bytes=size, request_id=name) for name, size in sent.items()]
    return make_run({}, extra=tuple(rows))


@pytest.mark.parametrize(
    ("plain", "coded", "verdict"),
    [
        (90_000, 120_000, SUPPORTED),
        (90_000, 160_000, CONTRADICTED),
        (90_000, 90_000, CONTRADICTED),
        (50_000, 66_667, SUPPORTED),
        (49_999, 66_666, UNDECIDED),  # small pictures do not count
    ],
)
def test_base64_is_judged_by_what_the_bodies_weigh(
    make_run: MakeRun, make_row: MakeRow, plain: int, coded: int, verdict: str
) -> None:
    assert claim_of("1.3333", bodies(make_run, make_row, plain, coded)).verdict == verdict
    assert not claim_of("1.3333", make_run(EVEN)).evidence  # no binary cell to compare with


def test_bodies_of_unlike_pictures_are_not_compared(make_run: MakeRun, make_row: MakeRow) -> None:
    rows = [
        make_row(name, EVEN["ros/topic"], 1, payload_bytes=size, payload=payload, request_id=name)
        for name, size, payload in (("http/as-deployed", 120_000, "jpeg"), ("http/binary", 90_000, "png"))
    ]
    assert not claim_of("1.3333", make_run({}, extra=tuple(rows))).evidence


def test_a_run_whose_parts_all_lack_something_says_what_the_nearest_lacks(make_run: MakeRun) -> None:
    parts = {"far": {"board", "mode"}, "near": {"model"}, "far too": {"board", "model"}}
    names = ("board", "mode", "model")
    needs = tuple(Need(name, "right", lambda found: found.startswith("right")) for name in names)

    def split(run: StoredRun) -> list[RunPart]:
        facts = (
            {name: f"{'wrong' if name in lacks else 'right'}, {part}" for name in names}
            for part, lacks in parts.items()
        )
        return [RunPart(run, each, ()) for each in facts]

    claim = replace(CLAIMS[0], trial=Trial("s2a-bench latency", split, needs))
    (finding,) = judge(claim, [make_run({}, manifest={})]).evidence
    assert (
        "; ".join(need.text for need in finding.needs)
        == "board: right, near; mode: right, near; model: wrong, near (needs right)"
    )


@pytest.mark.parametrize(
    ("board", "claimed", "stalls", "verdict"),  # of 7 gaps
    [
        ("jetson-agx-orin", "intermittent", 0, CONTRADICTED),
        ("jetson-agx-orin", "intermittent", 0.69, CONTRADICTED),
        ("jetson-agx-orin", "intermittent", 0.71, SUPPORTED),
        ("jetson-agx-orin", "intermittent", 6.29, SUPPORTED),
        ("jetson-agx-orin", "intermittent", 6.31, CONTRADICTED),
        ("jetson-orin-nano", "frequent", 3.5, CONTRADICTED),
        ("jetson-orin-nano", "frequent", 4, SUPPORTED),
    ],
)
def test_a_tenth_to_nine_tenths_of_the_gaps_are_intermittent_and_more_than_a_half_frequent(
    timelines: StoredRun, board: str, claimed: str, stalls: float, verdict: str
) -> None:
    rows = timelines.table(TIMELINES)
    rows = rows[(rows["board"] == board) & (rows["policy"] == "naive")].assign(stalls=stalls)
    assert claim_of(claimed, changed(timelines, timelines=rows)).verdict == verdict


def test_frequent_means_most_of_the_gaps_at_every_granularity(timelines: StoredRun) -> None:
    rows = timelines.table(TIMELINES)
    short = (rows["policy"] == "naive") & (rows["tokens_per_skill"] == 1)
    rows = rows.assign(stalls=rows["stalls"].mask(short, 3))
    assert claim_of("frequent", changed(timelines, timelines=rows)).verdict == UNDECIDED


@pytest.mark.parametrize(
    ("stalled_s", "verdict"),  # at L = 6, 4, 2, 1
    [
        ((3, 2, 1, 0.5), SUPPORTED),
        ((3, 0, 0, 0), SUPPORTED),
        ((0.03, 0.02, 0.01, 0), SUPPORTED),
        ((0.02, 0.01, 0, 0), UNDECIDED),  # 20 ms cannot be seen
        ((3, 3, 1, 0), CONTRADICTED),
        ((2, 3, 1, 0), CONTRADICTED),
        ((0, 0, 0, 0), UNDECIDED),  # nothing to compare
    ],
)
def test_more_tokens_more_stalls_needs_a_strict_increase(
    timelines: StoredRun, stalled_s: tuple[float, ...], verdict: str
) -> None:
    rows = timelines.table(TIMELINES)
    rows = rows[rows["board"] == "jetson-agx-orin"].copy()
    for tokens, stall_s in zip((6, 4, 2, 1), stalled_s, strict=True):
        rows.loc[rows["tokens_per_skill"] == tokens, "stall_ns"] = round(stall_s * 1e9)
    assert claim_of("More tokens", changed(timelines, timelines=rows)).verdict == verdict


@pytest.mark.parametrize(("factor", "verdict"), [(1.005, IDENTITY), (1.02, CONTRADICTED), (0.9, IDENTITY)])
def test_an_end_within_one_per_cent_of_naives_is_no_penalty(timelines: StoredRun, factor: float, verdict: str) -> None:
    rows = timelines.table(TIMELINES).copy()
    ours = rows["policy"] == "stream-to-act"
    rows.loc[ours, "end_ns"] = (rows.loc[ours, "end_ns"].astype("float64") * factor).round().astype("Int64")
    assert claim_of("at the end, S0 known", changed(timelines, timelines=rows)).verdict == verdict


@pytest.mark.parametrize(("factor", "verdict"), [(1.0, SUPPORTED), (1.05, CONTRADICTED)])
def test_a_later_end_contradicts_where_s0_is_estimated(tmp_path: Path, factor: float, verdict: str) -> None:
    config = TimelineComputed(profiles=("jetson-agx-orin",), jitter="lognormal:cv=0.2", plans=200)
    run = read_run(run_timeline(config, tmp_path, NullProgress()))
    rows = run.table(TIMELINES).copy()
    ours = rows["policy"] == "stream-to-act"
    rows.loc[ours, "end_ns"] = (rows.loc[ours, "end_ns"].astype("float64") * factor).round().astype("Int64")
    assert claim_of("at the end, S0 estimated", changed(run, timelines=rows)).verdict == verdict


def test_an_increase_that_may_be_none_decides_nothing(tmp_path: Path) -> None:
    config = TimelineComputed(
        profiles=("jetson-agx-orin",), policies=("naive",), tokens_per_skill=(4, 6), jitter="lognormal:cv=0.2", plans=40
    )
    run = read_run(run_timeline(config, tmp_path, NullProgress()))
    rows = run.table(TIMELINES).copy()
    rows["stall_ns"] = (rows["plan"] // 4 + rows["tokens_per_skill"] // 6) % 2 * 10**9  # in turn
    assert claim_of("More tokens", changed(run, timelines=rows)).verdict == UNDECIDED


def test_what_ends_with_stream_to_act_or_before_it_does_not_end_later(timelines: StoredRun) -> None:
    rows = timelines.table(TIMELINES).copy()
    rows.loc[rows["policy"] == "wait-then-act", "end_ns"] = 1_000_000_000
    early = changed(timelines, timelines=rows)
    assert claim_of("AGX Orin: wait-then-act", early).verdict == CONTRADICTED
    assert claim_of("preferable for fast and smooth control", early).verdict == CONTRADICTED


def test_where_nothing_can_be_stretched_only_fixed_durations_are_judged(tmp_path: Path) -> None:
    run = read_run(run_timeline(TimelineComputed(t_max=1.0), tmp_path, NullProgress()))
    assert claim_of("with fixed durations", run).verdict == IDENTITY
    assert not claim_of("up to T_max", run).tested


def test_below_the_boundary_jittered_stalls_decide_nothing(tmp_path: Path) -> None:
    jitter = BoundaryConfig(jitter="lognormal:cv=0.2", plans=50, points=10)
    assert claim_of("Below R", read_run(run_boundary(jitter, tmp_path, NullProgress()))).verdict == UNDECIDED


@pytest.mark.parametrize("t_min", [0.99, 1.0])
def test_at_another_t_min_than_the_chosen_the_papers_line_is_tried_without_a_verdict(
    tmp_path: Path, t_min: float
) -> None:
    run = read_run(run_boundary(BoundaryConfig(t_min=t_min), tmp_path, NullProgress()))
    assert claim_of("suffices", run).verdict == IDENTITY
    older = replace(run, manifest=run.manifest | {"configuration": {}})
    for each, missing in ((run, f"t_min {t_min}"), (older, "t_min unknown")):
        below = claim_of("Below R", each)
        assert not below.tested
        assert below.evidence[0].text.startswith("At your settings, no verdict: Naive stalls at 95 of 95 points below")
        assert missing in below.required


def test_the_chosen_settings_are_the_defaults_of_the_commands() -> None:
    point, plans, plane = (
        json.loads(json.dumps(kind().to_manifest())) for kind in (CcrbComputed, TimelineComputed, BoundaryConfig)
    )
    several = {"n_skills": [PLANS["n_skills"]], "t_nom_s": [PLANS["t_nom_s"]]}
    assert {name: point[name] for name in CHOSEN} == CHOSEN
    assert {name: plans[name] for name in PLANS} == PLANS | several
    assert {name: plane[name] for name in PLANE} == PLANE


@pytest.mark.parametrize(
    ("at_the_point", "in_the_diagram", "verdict"),
    [(True, False, REPRODUCED), (False, True, UNDECIDED), (False, False, CONTRADICTED), (False, None, UNDECIDED)],
)
def test_an_outcome_at_no_point_of_the_diagram_contradicts(
    ccrb: StoredRun, at_the_point: bool, in_the_diagram: bool | None, verdict: str
) -> None:
    rows = ccrb.table(ROLLOUTS).copy()
    naive = rows["policy"] == "naive"
    for study, held in (("point", at_the_point), ("phase", in_the_diagram)):
        if not held:
            rows.loc[naive & (rows["study"] == study), "outcome"] = "none"
    if in_the_diagram is None:
        rows = rows[rows["study"] != "phase"]
    assert claim_of("hit from behind", changed(ccrb, rollouts=rows)).verdict == verdict


def test_a_diagram_of_other_settings_contradicts_no_outcome(ccrb: StoredRun) -> None:
    rows = ccrb.table(ROLLOUTS).assign(outcome="both")
    settings = ccrb.manifest["configuration"] | {"phase_rates": [20.0, 40.0]}
    run = replace(changed(ccrb, rollouts=rows), manifest=ccrb.manifest | {"configuration": settings})
    assert claim_of("hit from behind", run).verdict == UNDECIDED


MakeRun = Callable[..., StoredRun]
ORIN = {"board": "NVIDIA Jetson AGX Orin Developer Kit"}
RTX = {"gpus": [{"name": "NVIDIA GeForce RTX 4080"}]}


def unmeasured(_: RunPart) -> tuple[list[Ratio], str]:
    return [], ""


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (1.0, 2.0, SUPPORTED),
        (0.9, 2.0, UNDECIDED),
        (1.0, 2.1, UNDECIDED),
        (0.9, 2.1, UNDECIDED),
        (0.5, 1.0, UNDECIDED),
        (2.0, 3.0, UNDECIDED),
        (0.5, 0.9, CONTRADICTED),
        (2.1, 3.0, CONTRADICTED),
    ],
)
def test_an_interval_is_wholly_between_the_bounds_or_wholly_outside_or_decides_nothing(
    low: float, high: float, verdict: str
) -> None:
    check = Check("", unmeasured, 1.0, 2.0)
    assert within(low, high, 1.0, 2.0) == check.verdict([Ratio(1.5, low, high)]) == verdict
    assert check.verdict([Ratio(1.5, low, None)]) == check.verdict([Ratio(1.5, None, high)]) == UNDECIDED
    assert Check("", unmeasured).verdict([Ratio(1.5, None, None)]) == SUPPORTED  # only stated


@pytest.mark.parametrize(
    ("verdicts", "verdict"),
    [
        ([SUPPORTED, SUPPORTED], SUPPORTED),
        ([SUPPORTED, UNDECIDED], UNDECIDED),
        ([SUPPORTED, UNDECIDED, CONTRADICTED], CONTRADICTED),
        ([], UNDECIDED),
    ],
)
def test_of_what_is_claimed_of_all_one_that_contradicts_is_enough(verdicts: list[str], verdict: str) -> None:
    assert all_of(verdicts) == verdict


@pytest.mark.parametrize(
    ("values", "each", "alike", "one"),
    [
        ((1, 2), SUPPORTED, SUPPORTED, SUPPORTED),
        ((1, 3), CONTRADICTED, UNDECIDED, SUPPORTED),
        ((0, 3), CONTRADICTED, UNDECIDED, UNDECIDED),
        ((3, 4), CONTRADICTED, CONTRADICTED, CONTRADICTED),
        ((0, -1), CONTRADICTED, CONTRADICTED, CONTRADICTED),
    ],
)
def test_values_lie_inside_each_or_together_or_one_of_them(
    values: tuple[float, ...], each: str, alike: str, one: str
) -> None:
    exact = [Ratio(value, value, value) for value in values]
    assert Check("", unmeasured, 1, 2).verdict(exact) == each
    assert Check("", unmeasured, 1, 2, "joint").verdict(exact) == alike
    assert Check("", unmeasured, 1, 2, "one").verdict(exact) == one


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.56, 0.6, SUPPORTED),
        (0.54, 0.6, UNDECIDED),
        (0.51, 0.52, UNDECIDED),
        (0.4, 0.46, UNDECIDED),
        (0.4, 0.44, CONTRADICTED),
    ],
)
def test_an_interval_within_the_margin_of_a_bound_decides_nothing(low: float, high: float, verdict: str) -> None:
    assert Check("", unmeasured, 0.5, margin=0.05).verdict([Ratio(0.5, low, high)]) == verdict


def test_more_than_a_half_is_not_a_half() -> None:
    more = Check("", unmeasured, nextafter(0.5, inf))
    assert more.verdict([Ratio(0.5, 0.5, 0.5)]) == CONTRADICTED
    assert more.verdict([Ratio(0.6, 0.5, 0.7)]) == UNDECIDED
    assert more.verdict([Ratio(0.6, 0.51, 0.7)]) == SUPPORTED


@pytest.mark.parametrize(
    ("testable", "others", "verdict"),
    [
        ([], [], UNDECIDED),
        ([], [UNDECIDED], UNDECIDED),
        ([SUPPORTED], [], SUPPORTED),
        ([SUPPORTED, SUPPORTED], [UNDECIDED], SUPPORTED),
        ([REPRODUCED], [UNDECIDED], REPRODUCED),
        ([CONTRADICTED], [SUPPORTED], CONTRADICTED),
        ([UNDECIDED], [], UNDECIDED),
        ([UNDECIDED], [SUPPORTED], UNDECIDED),
        ([SUPPORTED, UNDECIDED], [], UNDECIDED),
        ([CONTRADICTED, UNDECIDED], [], UNDECIDED),
        ([SUPPORTED, CONTRADICTED], [], UNDECIDED),
    ],
)
def test_runs_that_can_tell_have_to_agree_and_no_other_counts(
    testable: list[str], others: list[str], verdict: str
) -> None:
    findings = [ClaimFinding(verdict, str(place), (Met("board: it", True),)) for place, verdict in enumerate(testable)]
    findings += [ClaimFinding(verdict, "", (Met("board: another (needs it)", False),)) for verdict in others]
    for order in (findings, findings[::-1]):
        judged = combine(CLAIMS[0], dict.fromkeys(order, ("run",)))
        assert judged.verdict == verdict
        assert judged.tested == bool(testable)
        assert any("disagree" in note for note in judged.notes) == (len(set(testable)) > 1)
        assert any(note.startswith("Run: ") for note in judged.notes) == (not testable)


@pytest.mark.parametrize(
    ("offload", "layers", "found", "met"),
    [
        (True, -1, "all layers on the GPU", True),
        (True, 28, "all layers on the GPU", True),
        (True, 27, "27 layers on the GPU", False),
        (True, 0, "CPU", False),
        (False, 28, "CPU", False),
        (None, 28, "unknown", False),
        (True, None, "unknown", False),
    ],
)
def test_a_model_is_on_the_gpu_with_all_its_28_layers(
    make_run: MakeRun, offload: bool | None, layers: int | None, found: str, met: bool
) -> None:
    model = {"gpu_offload_supported": offload, "gpu_layers": layers, "model_sha256": "ab"}
    run, ours = make_run({}, manifest={"model": model}), Provenance(model_sha256="ab")
    on_gpu = PAPERS_MODEL[2].of(facts_of(run, [ours]))
    assert on_gpu.met == met
    assert on_gpu.text.startswith(f"processor: {found}")
    assert facts_of(run, [ours, Provenance(model_sha256="cd")])["processor"] == "unknown"


@pytest.mark.parametrize(
    ("environment", "name", "same"),
    [
        (ORIN, "Jetson AGX Orin", True),
        (ORIN, "Jetson Orin Nano", False),
        ({"board": "NVIDIA Jetson Orin Nano Super Developer Kit"}, "Jetson AGX Orin", False),
        ({"board": "AGX Orin NX"}, "Jetson AGX Orin", True),
        ({"board": "AGX"}, "Jetson AGX Orin", False),
        (RTX, "RTX 4080", True),
        ({"gpus": [{}, {"name": "My NVIDIA GeForce RTX 4080 16 GB"}]}, "RTX 4080", True),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 4080 SUPER"}]}, "RTX 4080", False),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 4080 Laptop GPU"}]}, "RTX 4080", False),
        ({"gpus": [{"name": "NVIDIA GeForce RTX 40800"}]}, "RTX 4080", False),
        ({}, "RTX 4080", False),
    ],
)
def test_a_board_is_known_by_its_whole_name(
    make_run: MakeRun, environment: dict[str, Any], name: str, same: bool
) -> None:
    assert on_board(name).of(facts_of(make_run({}, manifest={"environment": environment}), [])).met == same


@pytest.mark.parametrize(
    ("environment", "named"),
    [
        (RTX | {"cpu": "AMD Ryzen 9"}, "AMD Ryzen 9, NVIDIA GeForce RTX 4080"),
        (ORIN | {"gpus": []}, "NVIDIA Jetson AGX Orin Developer Kit"),
        ({}, "a machine that is not known"),
    ],
)
def test_a_machine_is_named_by_what_is_known_of_it(make_run: MakeRun, environment: dict[str, Any], named: str) -> None:
    assert facts_of(make_run({}, manifest={"environment": environment}), [])["board"] == named
