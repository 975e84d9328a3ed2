from collections.abc import Callable
from typing import Any

import pytest

from s2a_bench.experiments.requests import cells_of
from s2a_bench.stats import summary_of
from s2a_bench.store.requests import SampleRow
from s2a_bench.trace import path_of
from s2a_bench.writers.tables import Note
from tests.made_runs import STAGES, MakeRun

HAND = {
    "ros/topic": {"capture": 1, "cdr_pack": 2, "": 0.5, "network": 3, "inference": 100, "return": 1.5},
    "http/as-deployed": {
        "capture": 1,
        "convert": 2,
        "image_encode": 3,
        "": 1,
        "connect": 4,
        "network": 5,
        "inference": 100,
        "return": 8,
    },
}


def test_cells_stand_in_a_fixed_order_whatever_the_order_of_the_samples(make_run: MakeRun) -> None:
    stages = {"capture": 1, "inference": 1, "return": 1}
    names = ["loopback", "pigeon", "ros/topic", "http/binary", "http/as-deployed", "http/best-effort"]
    run = make_run(dict.fromkeys(names, stages), n=2)
    expected = ["http/as-deployed", "http/best-effort", "http/binary", "ros/topic", "loopback", "pigeon"]
    assert [cell.name for cell in cells_of(run)] == expected


def test_the_samples_of_a_run_may_be_others_than_those_of_its_files(make_run: MakeRun) -> None:
    run = make_run(HAND, n=4)
    run.tables["samples"] = run.samples[run.samples["cell"] == "ros/topic"]
    (ros,) = cells_of(run)
    assert (ros.name, ros.n) == ("ros/topic", 4)


def test_stages_and_groups_of_a_cell_by_hand(make_run: MakeRun) -> None:
    cells = cells_of(make_run(HAND, n=4, spread=0))
    http, ros = cells
    assert http.values("convert").tolist() == [2.0] * 4
    assert http.values("group.encode").tolist() == [5.0] * 4
    assert http.values("group.network").tolist() == [9.0] * 4
    assert http.values("e2e").tolist() == [124.0] * 4
    assert http.values("e2e_without_inference").tolist() == [24.0] * 4
    assert http.values("ttft").tolist() == [123.0] * 4
    assert http.values("residual_share").tolist() == [1 / 24] * 4
    assert ros.values("group.network").tolist() == [3.0] * 4
    assert ros.values("group.encode").size == 0
    assert summary_of(ros.values("group.encode")) is None
    assert cells.only([ros]).groups == ["capture", "pack", "network", "inference", "return"]
    assert cells.only([ros]).stages == ["capture", "cdr_pack", "network", "inference", "return"]


def test_warm_ups_and_failures_are_counted_and_not_summarised(
    make_run: MakeRun, make_row: Callable[..., SampleRow]
) -> None:
    extra = (
        make_row("ros/topic", HAND["ros/topic"], 90, error="lost"),
        make_row("ros/topic", {"capture": 9e9, "return": 1}, 91, warmup=True),
        make_row("ros/topic", HAND["ros/topic"], 92, error="lost", warmup=True),
    )
    (ros,) = cells_of(make_run({"ros/topic": HAND["ros/topic"]}, n=4, spread=0, extra=extra))
    assert (ros.n, ros.errors, ros.warmups) == (4, 1, 7)
    assert ros.values("e2e").tolist() == [108.0] * 4


def test_the_time_between_tokens_is_taken_inside_each_request_only(make_run: MakeRun) -> None:
    (ros,) = cells_of(make_run({"ros/topic": HAND["ros/topic"]}, n=4, n_tokens=3))
    assert ros.values("itl").tolist() == [2.0] * 8
    (ros,) = cells_of(make_run({"ros/topic": HAND["ros/topic"]}, n=4, n_tokens=1))
    assert ros.values("itl").size == 0


def test_a_residual_above_five_per_cent_is_flagged(make_run: MakeRun, make_row: Callable[..., SampleRow]) -> None:
    extra = (make_row("ros/topic", HAND["ros/topic"] | {"": 0.36}, 9),)  # 0.36 of 7.86 is 4.6 %; 0.5 of 8 is 6.3 %
    (ros,) = cells_of(make_run({"ros/topic": HAND["ros/topic"]}, n=4, spread=0, extra=extra))
    assert ros.flagged() == 4


def test_ratios_are_http_over_ros_and_everything_over_loopback(make_run: MakeRun) -> None:
    found = [(metric, of.name, to.name) for metric, of, to, _ in cells_of(make_run(n=3)).ratios]
    pairs = [
        ("http/as-deployed", "ros/topic"),
        ("http/best-effort", "ros/topic"),
        ("http/binary", "ros/topic"),
        ("http/as-deployed", "loopback"),
        ("http/best-effort", "loopback"),
        ("http/binary", "loopback"),
        ("ros/topic", "loopback"),
    ]
    assert found == [(metric, *pair) for metric in ("e2e_without_inference", "e2e") for pair in pairs]


def test_a_ratio_by_hand_pairs_the_blocks(make_run: MakeRun) -> None:
    first, second = cells_of(make_run(HAND, n=10, spread=0)).ratios
    assert first[0] == "e2e_without_inference"
    assert (first[3].value, first[3].low, first[3].high) == (3.0, pytest.approx(3), pytest.approx(3))  # 24 ms over 8 ms
    assert second[3].value == pytest.approx(124 / 108)


def test_cells_of_which_one_lacks_a_sample_are_compared_without_pairs(
    make_run: MakeRun, make_row: Callable[..., SampleRow]
) -> None:
    extra = (make_row("ros/topic", HAND["ros/topic"], 99),)
    first, _ = cells_of(make_run(HAND, n=10, spread=0, extra=extra)).ratios
    assert first[3].value == 3.0
    assert first[3].low == pytest.approx(3)


LLAMA_SERVER = {"capture": 0.1, "json_pack": 0.3, "ingest": 20.0, "inference": 95.0}


def test_a_llama_server_and_an_engine_that_tells_no_preprocessing_are_compared_end_to_end_only(
    make_run: MakeRun,
) -> None:
    cells = cells_of(make_run({"http/as-deployed": LLAMA_SERVER, "ros/topic": HAND["ros/topic"]}, n=3))
    assert [metric for metric, *_ in cells.ratios] == ["e2e"]


def test_a_llama_server_is_compared_without_model_where_both_tell_it(make_run: MakeRun) -> None:
    ours = {"capture": 0.4, "cdr_pack": 2.0, "network": 5.0, "preprocess": 20.0, "inference": 80.0, "return": 0.6}
    cells = {"http/llama-server": LLAMA_SERVER, "ros/topic": ours}
    run = make_run(cells, n=3, spread=0, manifest={"stages": path_of([STAGES])}, server_prompt_ms=80.0)
    found = {metric: ratio.value for metric, _, _, ratio in cells_of(run).ratios}
    assert found == {"e2e_without_model": pytest.approx(35.4 / 28), "e2e": pytest.approx(115.4 / 108)}


def test_what_did_not_really_answer_is_said(make_run: MakeRun) -> None:
    def note(**facts: Any) -> Note:
        return cells_of(make_run(HAND, n=1, **facts)).engine_note

    assert (note(), note().labels) == ("echo engine", ("echo engine",))
    drawn = {"model": {"engine": "echo", "model": "none", "emulated": True, "latency": "80"}}
    assert note(manifest=drawn) == "echo engine, EMULATED: latencies 80 ms"
    assert note(manifest=drawn).labels == ("echo engine", "emulated")
    assert note(engine="replay") == "EMULATED: replayed profile"
    played = {"profile": "agx", "gaps": "trace", "origin": "measured", "dummy": True}
    assert note(engine="replay", manifest={"model": played}) == (
        "EMULATED: replayed profile agx (trace gaps, recorded with dummy weights)"
    )
    assert note(engine="replay", manifest={"model": played}).sentence().labels == ("emulated", "dummy weights")
    played |= {"gaps": "constant", "origin": "paper", "dummy": False}
    assert note(engine="replay", manifest={"model": played}) == (
        "EMULATED: replayed profile agx (constant gaps, the paper's rate)"
    )
    assert note(engine="llama", manifest={"model": {"dummy": True}}) == "dummy weights"
    unseen = {"engine": "llama", "dummy": True, "pictures": "not seen"}
    assert note(engine="llama", manifest={"model": unseen}) == "dummy weights, picture not seen"
    assert note(engine="llama", manifest={"model": {"dummy": False}}) == ""
    assert note(engine="llama") == ""
