"""Two runs side by side: what belongs together, what is refused, what is called a change, and what a gate does."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from s2a_bench.errors import UnlikeRuns, UsageError
from s2a_bench.experiments.cells import Metric
from s2a_bench.experiments.latency import metrics as latency
from s2a_bench.experiments.throughput import metrics as throughput
from s2a_bench.experiments.timeline.view import cells as timeline
from s2a_bench.report.compare.agreement import differences
from s2a_bench.report.compare.comparison import (
    ComparedRuns,
    compare,
    metrics_of,
    open_comparison,
    warnings_of,
)
from s2a_bench.report.compare.gates import Gated, concerned, judge, read_gate
from s2a_bench.report.compare.shown import (
    build_forest,
    compare_csv,
    compare_json,
    compare_table,
    percent,
    write_comparison,
)
from s2a_bench.stats.batches import STATISTICS, Rows
from s2a_bench.stats.change import Noise, change_between
from s2a_bench.store.requests import SampleRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run
from tests.made_runs import STAGES as GROUPS

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/s2a-bench-compare-1.json").read_text())
STAGES = {"capture": 1.0, "image_encode": 2.0, "network": 4.0, "inference": 0.5, "return": 2.5}
CELLS = {"http/as-deployed": STAGES, "http/binary": STAGES, "ros/topic": STAGES, "loopback": STAGES}
MACHINE = {"cpu": "Cortex-A78AE", "cores": 12, "governor": "performance", "packages": {"numpy": "2.4"}, "load": [0.1]}
MODEL = {"engine": "llama", "dummy": False, "model_sha256": "aa"}
MANIFEST = {"environment": MACHINE, "model": MODEL, "configuration": {"runs": 60, "http": {"payload": "jpeg"}}}

MakeRow = Callable[..., SampleRow]
Launch = Callable[..., StoredRun]


@pytest.fixture
def launch(tmp_path: Path, make_row: MakeRow) -> Launch:
    """Write a run whose cells share the machine's ups and downs, which are alike from block to block."""

    def make(
        seed: int,
        *,
        factor: float = 1.0,
        n: int = 60,
        correlation: float = 0.4,
        cells: Any = tuple(CELLS),
        manifest: dict[str, Any] | None = None,
        launches: int = 1,
        **facts: Any,
    ) -> StoredRun:
        rng = np.random.default_rng(seed)
        load = 0.0
        with RunWriter.create(tmp_path, "latency", {"stages": GROUPS} | (manifest or MANIFEST)) as run:
            for block in range(n):
                load = correlation * load + np.sqrt(1 - correlation**2) * rng.standard_normal()
                for cell in cells:
                    slow = np.exp(0.08 * load + 0.08 * rng.standard_normal()) * factor
                    marks, at_ns = [("", 10**9)], 10**9
                    for stage, length_ms in STAGES.items():
                        at_ns += round(length_ms * slow * 1e6)
                        marks.append((stage, at_ns))
                    run.sample(make_row(cell, STAGES, block, marks=marks, launch=block * launches // n, **facts))
        return read_run(run.path)

    return make


def opened(first: StoredRun, second: StoredRun, *, unlike: bool = False, least: float = 0.05) -> ComparedRuns:
    return open_comparison([first], [second], unlike=unlike, least=least)


def compared(first: StoredRun, second: StoredRun, *names: str, **settings: Any) -> ComparedRuns:
    both = opened(first, second, **settings)
    return compare(both, metrics_of(both, names))


def verdicts(found: ComparedRuns) -> list[str]:
    return [one.verdict for one in found.comparisons]


def with_(manifest: dict[str, Any], part: str, **facts: Any) -> dict[str, Any]:
    return {**manifest, part: {**manifest[part], **facts}}


@pytest.mark.slow
def test_a_comparison_of_the_same_thing_finds_nothing_in_at_least_95_of_100_repeats(launch: Launch) -> None:
    """The whole command: four cells, two metrics, samples that are alike from block to block, Holm over all."""
    clean = 0
    for repeat in range(100):
        found = compared(launch(2 * repeat), launch(2 * repeat + 1))
        assert len(found.comparisons) == 8
        clean += not {"better", "worse"} & set(verdicts(found))
    assert clean >= 95


def test_a_change_below_the_smallest_effect_is_none_however_sure_it_is(launch: Launch) -> None:
    first, second = (launch(seed, n=1000, correlation=0, factor=by) for seed, by in ((1, 1), (2, 1.025)))
    assert set(verdicts(compared(first, second, "e2e.mean"))) == {"same"}
    assert set(verdicts(compared(first, second, "e2e.mean", least=0.01))) == {"worse"}


def test_what_is_better_depends_on_the_metric() -> None:
    every = [latency.COMPARED, throughput.COMPARED, timeline.COMPARED]
    directions = {name: metric.better for by in every for name, metric in by.metrics.items()}
    assert directions["e2e"] == directions["stall_s"] == directions["itl"] == "lower"
    assert directions["tokens_per_s"] == directions["fluidity"] == "higher"
    assert all(metric.statistic in STATISTICS for by in every for metric in by.metrics.values())
    assert all(name in by.metrics for by in every for name in by.shown)


def test_metrics_that_only_one_run_has_can_be_named(launch: Launch, monkeypatch: pytest.MonkeyPatch) -> None:
    own = replace(latency.COMPARED, run_metrics=lambda run: [Metric(unit="ms", name=f"squash{run.manifest['more']}")])
    monkeypatch.setattr(latency, "COMPARED", own)
    both = opened(*(launch(seed, n=6, manifest={**MANIFEST, "more": seed}) for seed in (1, 2)))
    assert list(both.metrics)[-2:] == ["squash1", "squash2"]


def test_cells_without_a_partner_are_listed_and_not_compared(launch: Launch) -> None:
    found = compared(launch(1, cells=("ros/topic", "loopback")), launch(2, cells=("ros/topic", "http/binary")), "e2e")
    assert [one.pair.name for one in found.comparisons] == ["ros/topic"]
    assert found.only == (("loopback",), ("http/binary",))
    assert [warning.message for warning in warnings_of(found) if warning.code == "only"] == [
        "only in A: loopback",
        "only in B: http/binary",
    ]
    with pytest.raises(UnlikeRuns, match="no cell is in every run: loopback against ros/topic"):
        opened(launch(1, cells=("loopback",)), launch(2, cells=("ros/topic",)))


@pytest.mark.parametrize("place", [0, 1])
def test_a_run_without_a_complete_cell_is_named(launch: Launch, place: int) -> None:
    runs = [launch(1, n=6), launch(2, n=6)]
    runs[place] = empty = launch(3, n=0)
    with pytest.raises(UnlikeRuns) as caught:
        opened(*runs)
    state = empty.manifest["state"]
    assert str(caught.value) == f"{empty.path} has no complete cell, its state is {state}: measure it again"


@pytest.mark.parametrize(
    ("part", "facts", "message"),
    [
        ("environment", {"cpu": "EPYC"}, "cpu: Cortex-A78AE against EPYC"),
        ("environment", {"cores": 6}, "cores: 12 against 6"),
        ("environment", {"governor": "powersave"}, "governor: performance against powersave"),
        ("model", {"model_sha256": "bb"}, "model model_sha256: aa against bb"),
        ("model", {"dummy": True}, "model dummy: False against True"),
        ("model", {"engine": "replay"}, "model engine: llama against replay"),
    ],
)
def test_another_machine_or_model_is_refused_unless_told(
    launch: Launch, part: str, facts: dict[str, Any], message: str
) -> None:
    first, second = launch(1, n=6), launch(2, n=6, manifest=with_(MANIFEST, part, **facts))
    with pytest.raises(UnlikeRuns) as caught:
        opened(first, second)
    assert str(caught.value) == f"the runs are unlike: {message}; `unlike` compares them anyway"
    warning = next(
        warning for warning in warnings_of(compared(first, second, "e2e", unlike=True)) if warning.code == "unlike"
    )
    assert warning.message == f"the runs are unlike: {message}"


def test_another_gpu_is_refused_and_another_driver_is_told(launch: Launch) -> None:
    def with_gpu(name: str, driver: str) -> StoredRun:
        return launch(1, n=2, manifest=with_(MANIFEST, "environment", gpus=[{"name": name, "driver": driver}]))

    found = [(one.what, one.fatal) for one in differences(with_gpu("Orin", "1"), with_gpu("H200", "2"))]
    assert found == [("GPU name", True), ("GPU driver", False)]


def test_versions_and_settings_are_told_and_not_refused(launch: Launch) -> None:
    manifest = with_(MANIFEST, "environment", packages={"numpy": "2.5"}, kernel="6.1", load=[9.0])
    manifest["configuration"] = {"runs": 60, "http": {"payload": "png"}}
    found = opened(launch(1, n=6), launch(2, n=6, manifest=manifest)).differences
    assert [str(one) for one in found] == [
        "kernel: not known against 6.1",
        "package numpy: 2.4 against 2.5",
        "configuration http.payload: jpeg against png",
    ]
    assert not any(one.fatal for one in found)


def test_another_setting_under_the_same_name_is_refused_unless_told(launch: Launch) -> None:
    first, second = launch(1, cells=("http/binary",)), launch(2, cells=("http/binary",), payload="jpeg")
    with pytest.raises(UnlikeRuns, match="cells of one name differ: http/binary payload: raw against jpeg; `unlike`"):
        opened(first, second)
    assert len(compared(first, second, "e2e", unlike=True).comparisons) == 1


def test_runs_of_two_commands_are_never_compared(launch: Launch, tmp_path: Path) -> None:
    with RunWriter.create(tmp_path, "throughput", MANIFEST) as other:
        pass
    with pytest.raises(UsageError, match="these are runs of latency and throughput"):
        opened(launch(1, n=2), read_run(other.path), unlike=True)
    with RunWriter.create(tmp_path, "boundary", MANIFEST) as other:
        pass
    computed = read_run(other.path)
    with pytest.raises(
        UsageError, match="runs of boundary cannot be compared, only those of capacity, latency, task, throughput"
    ):
        opened(computed, computed)


def test_what_went_wrong_in_a_run_is_told(launch: Launch, tmp_path: Path, make_row: MakeRow) -> None:
    warned = {**MANIFEST, "warnings": [{"code": "load", "message": "m", "advice": "a"}]}
    with RunWriter.create(tmp_path, "latency", warned) as run:
        for block in range(20):
            run.sample(make_row("loopback", STAGES, block, error="lost" if block < 3 else ""))
        run.finish("interrupted")
    found = warnings_of(compared(launch(1, cells=("loopback",)), read_run(run.path), "e2e"))
    messages = {warning.code: warning.message for warning in found}
    assert messages["state"].endswith("is interrupted, not finished")
    assert messages["warnings"].endswith("has warnings: load")
    assert messages["errors"] == "loopback: 3 of 20 requests failed in B"
    assert "one-launch" in messages


def test_repeated_launches_are_compared_by_launch(launch: Launch) -> None:
    sides = [[launch(10 * side + each) for each in range(3)] for side in (1, 2)]
    both = open_comparison(*sides, unlike=False, least=0.05)
    found = compare(both, metrics_of(both, ["e2e"]))
    assert found.launches
    assert [one.n for one in found.comparisons] == [(180, 180)] * 4
    assert "one-launch" not in {warning.code for warning in warnings_of(found)}
    assert "over launches" in compare_table(found).notes[1]
    with pytest.raises(UsageError, match="several launches on both sides, or one on each"):
        open_comparison(sides[0], sides[1][:1], unlike=False, least=0.05)


def test_a_metric_that_there_is_not_is_answered_by_those_there_are(launch: Launch) -> None:
    both = opened(launch(1, n=6), launch(2, n=6))
    with pytest.raises(
        UsageError, match="'speed' is not a metric of these latency runs; there are e2e_without_inference, "
    ):
        metrics_of(both, ["speed"])
    with pytest.raises(UsageError, match=r"'e2e\.p98' is not a metric .*; the statistics are median, mean, p90, p99"):
        metrics_of(both, ["e2e.p98"])
    with pytest.raises(UsageError, match="no cell has base64_encode on both sides"):
        metrics_of(both, ["base64_encode"])
    assert [(metric.name, statistic) for metric, statistic in metrics_of(both, ["e2e", "group.encode.p90", "e2e"])] == [
        ("e2e", "median"),
        ("group.encode", "p90"),
    ]
    found = compare(both, metrics_of(both, ["all"]))
    assert {one.metric.name for one in found.comparisons} >= {"capture", "group.network", "e2e", "residual"}


@pytest.mark.parametrize(
    ("text", "cells", "metric", "rises", "limit"),
    [
        ("e2e.median>5%", "", "e2e.median", True, 0.05),
        ("tokens_per_s<-2.5%", "", "tokens_per_s", False, -0.025),
        (" ros/topic:e2e.p99 > 10 % ", "ros/topic", "e2e.p99", True, 0.1),
        ("a:b/*:group.encode<- 0%", "a:b/*", "group.encode", False, 0.0),
    ],
)
def test_a_gate_is_read(text: str, cells: str, metric: str, rises: bool, limit: float) -> None:
    gate = read_gate(text)
    assert (gate.cells, gate.metric, gate.rises, gate.limit) == (cells, metric, rises, limit)


@pytest.mark.parametrize(
    "text", ["", "e2e", "e2e>5", "e2e<5%", "e2e>-5%", "e2e=5%", ">5%", "e2e>five%", "e2e>5%x", "e2e>>5%"]
)
def test_what_is_no_gate_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match=r"`fail_if`: .* should look like e2e\.median>5%"):
        read_gate(text)


def outcomes(found: ComparedRuns, *gates: str, **settings: bool) -> set[str]:
    return {one.outcome for one in judged(found, *gates, **settings)}


def judged(found: ComparedRuns, *texts: str, strict: bool = False, one_launch: bool = True) -> list[Gated]:
    gates = [read_gate(text) for text in texts]
    return judge(compare(found, concerned(found, gates)), gates, strict=strict, one_launch=one_launch)


def test_table_and_gate_come_from_one_correction(launch: Launch) -> None:
    found = opened(launch(1, n=40), launch(2, n=40, factor=1.08))
    gates = [read_gate("http/binary:e2e.median>5%")]
    both = compare(found, [*metrics_of(found, ["all"]), *concerned(found, gates)])
    (one,) = judge(both, gates)
    assert one.p_holm in {each.p_holm for each in both.comparisons}
    assert len(both.comparisons) == len({(each.pair.name, each.name) for each in both.comparisons})
    alone = judged(found, "http/binary:e2e.median>5%")[0].p_holm
    assert one.p_holm > alone


def test_a_gate_trips_beyond_its_limit_only(launch: Launch) -> None:
    found = opened(launch(1, n=300), launch(2, n=300, factor=1.1))
    assert outcomes(found, "e2e>5%") == {"tripped"}
    assert outcomes(found, "e2e>20%") == {"passed"}
    assert outcomes(found, "e2e<-5%") == {"passed"}
    back = opened(launch(2, n=300, factor=1.1), launch(1, n=300))
    assert outcomes(back, "e2e<-5%") == {"tripped"}
    assert outcomes(back, "e2e>0%") == {"passed"}  # as the change the other way is one
    assert {one.cell for one in judged(found, "http/*:e2e>5%")} == {
        "http/as-deployed",
        "http/binary",
    }


@pytest.mark.parametrize(
    ("text", "rises", "beyond"),
    [("a>5%", True, True), ("a>5%", False, False), ("a<-5%", True, False), ("a<-5%", False, True)],
)
def test_a_change_from_nothing_is_past_a_limit_of_its_direction(text: str, rises: bool, beyond: bool) -> None:
    assert read_gate(text).beyond(None, rises) == beyond


def test_a_gate_does_not_trip_on_noise_unless_it_is_strict(launch: Launch) -> None:
    found = opened(launch(1, n=10, cells=("loopback",)), launch(2, n=10, cells=("loopback",), factor=1.02))
    (one,) = judged(found, "e2e>0%")
    assert one.p_holm > 0.05
    rises = (one.change or 0) > 0
    assert one.outcome == "undecided"
    assert one.detectable > 0.02
    assert outcomes(found, f"e2e>{one.detectable * 100 + 0.1:.1f}%") == {"passed"}
    assert outcomes(found, "e2e>0%" if rises else "e2e<-0%", strict=True) == {"tripped"}


def test_launches_of_one_folder_count_as_launches(launch: Launch) -> None:
    folders = [launch(1, n=60, launches=3), launch(2, n=60, launches=3)]
    found = compared(*folders, "e2e")
    assert found.launches
    assert {one.n for one in found.comparisons} == {(60, 60)}
    assert "one-launch" not in {warning.code for warning in warnings_of(found)}
    apart = [[launch(10 * side + each) for each in range(3)] for side in (1, 2)]
    both = open_comparison(folders[:1], apart[1], unlike=False, least=0.05)
    assert [len(side) for side in (both.pairs[0].baseline, both.pairs[0].other)] == [3, 3]


def measured_in(order: str, launch: Launch, *, launches: int = 1, factor: float = 2.0) -> ComparedRuns:
    """Compare runs of A and of B, ``factor`` times as long, that started in this order."""
    sides: dict[str, list[StoredRun]] = {"A": [], "B": []}
    for place, side in enumerate(order):
        run = launch(place, n=30, launches=launches, factor=factor if side == "B" else 1, cells=("loopback",))
        dated = {**run.manifest, "started": f"2026-01-01T00:{place:02}:00+00:00"}
        sides[side].append(replace(run, manifest=dated))
    return open_comparison(sides["A"], sides["B"], unlike=False, least=0.05)


@pytest.mark.parametrize(("order", "judges"), [("AB", False), ("ABBA", False), ("ABBAAB", True)])
def test_a_gate_needs_three_launches_a_side_or_the_users_word(launch: Launch, order: str, judges: bool) -> None:
    found = measured_in(order, launch)
    for gate, outcome in (("e2e>5%", "tripped"), ("e2e<-5%", "passed")):
        assert outcomes(found, gate) == {outcome}
        assert outcomes(found, gate, one_launch=False) == {outcome if judges else "undecided"}
        assert outcomes(found, gate, one_launch=False, strict=True) == {outcome}
    reasons = {one.reason for one in judged(found, "e2e>5%", one_launch=False)}
    way_out = "launches that a side needs: measure A and B in turn, a launch each, three times or more, and name the "
    assert reasons == {"" if judges else f"{len(order) // 2} of the 3 {way_out}folders with commas, or --one-launch"}


def test_a_gate_on_sides_that_did_not_take_turns_is_undecided_and_a_note_says_why(launch: Launch) -> None:
    found = measured_in("AAABBB", launch)
    for one_launch in (False, True):
        (one,) = judged(found, "e2e>5%", one_launch=one_launch)
        assert one.outcome == "undecided"
        assert "not measured in turn (6 launches, changes of side: 1)" in one.reason
        assert one.reason.endswith("three times or more, and name the folders with commas, or --strict")
    assert outcomes(found, "e2e>5%", strict=True) == {"tripped"}
    notes = {warning.code: warning.message for warning in warnings_of(compare(found, metrics_of(found, ["e2e"])))}
    assert notes["turns"] in one.reason
    assert not measured_in("ABABAB", launch).out_of_turn
    assert measured_in("ABAB", launch, launches=3).out_of_turn  # the launches of a folder are a block
    undated = replace(found, started=(("", "", ""), found.started[1]))
    assert "a manifest has no `started`" in judged(undated, "e2e>5%")[0].reason


def dated(order: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    first, second = (tuple(f"{place:03}" for place, each in enumerate(order) if each == side) for side in "AB")
    return first, second


@pytest.mark.parametrize("n", [3, 5, 10, 20])
def test_turns_of_two_launches_are_turns_and_blocks_of_three_are_none(launch: Launch, n: int) -> None:
    found = opened(launch(1, n=2), launch(2, n=2))
    turns = ("AB" * n, ("ABBA" * n)[: 2 * n] if n % 2 == 0 else ("ABBA" * n)[: 2 * n - 2] + "AB", "A" + "BBAA" * n)
    blocks = ("A" * n + "B" * n, ("AAABBB" * n)[: n // 3 * 6], "B" * 7 + "A" * n + "B" * 7)
    for orders, passes in ((turns, True), (blocks, False)):
        for order in orders:
            assert bool(replace(found, started=dated(order)).out_of_turn) != passes, order
    rng = np.random.default_rng(n)
    drawn = [dated("".join(rng.permutation(list("AB" * n)))) for _ in range(400)]
    assert np.mean([not replace(found, started=each).out_of_turn for each in drawn]) > 0.78


def test_a_drift_is_no_change_where_the_sides_take_turns(launch: Launch) -> None:
    """Half of the variance of a launch is its hour's: a random walk over twenty launches."""
    found, rng = opened(launch(1, n=2), launch(2, n=2)), np.random.default_rng(0)

    def drawn() -> str:
        texts = iter(lambda: "".join(rng.permutation(list("AB" * 10))), "")
        return next(text for text in texts if not replace(found, started=dated(text)).out_of_turn)

    def false_alarms(order: Callable[[], str]) -> float:
        alarms = 0
        for _ in range(300):
            drift, text = np.cumsum(rng.standard_normal(20)), order()
            values = np.exp(0.08 * (rng.standard_normal(20) + (drift - drift.mean()) / 1.8))
            first, second = (
                [Rows(one) for one, of in zip(values[:, None], text, strict=True) if of == side] for side in "AB"
            )
            alarms += (change_between(first, second, "median", seed=0).p or 1) < 0.05
        return alarms / 300

    assert false_alarms(lambda: "AB" * 10) < 0.05
    assert false_alarms(lambda: "ABBA" * 5) < 0.05
    assert false_alarms(drawn) < 0.08
    assert false_alarms(lambda: "A" * 10 + "B" * 10) > 0.3


@pytest.mark.parametrize(("rows", "rises", "falls"), [(1, 0.1503, 0.1307), (4, 0.1817, 0.1538)])
def test_a_gate_passes_from_the_limit_on_that_it_would_have_seen(
    launch: Launch, rows: int, rises: float, falls: float
) -> None:
    """With a known error of 5 % that is exp((z + 0.8416) 0.05) - 1, z the normal quantile of 1 - 0.025 / rows."""
    first, second = (launch(seed, n=10, cells=[*CELLS][:rows]) for seed in (1, 2))
    found = compared(first, second, "e2e")
    quiet = [replace(one, p_holm=1.0, change=replace(one.change, noise=Noise(0.05, 1e5))) for one in found.comparisons]
    same = replace(found, comparisons=tuple(quiet))
    for gate, least in (("e2e>{}%", rises), ("e2e<-{}%", falls)):
        for share, outcome in ((0.98, "undecided"), (1.02, "passed")):
            one = judge(same, [read_gate(gate.format(round(100 * least * share, 3)))], one_launch=True)[0]
            assert one.outcome == outcome
            assert one.detectable == pytest.approx(least, rel=0.002)


def test_a_gate_that_too_few_values_feed_is_undecided_not_passed(launch: Launch) -> None:
    found = opened(launch(1), launch(2, factor=2))
    assert outcomes(found, "e2e.p99>10%") == {"undecided"}
    assert outcomes(found, "e2e.p99>10%", strict=True) == {"tripped"}


def test_the_json_object_is_what_its_schema_says(launch: Launch) -> None:
    found = compared(launch(1), launch(2, factor=1.2), "e2e", "e2e.p99")
    whole = compare_json(found, judge(found, [read_gate("e2e>5%")], one_launch=True), warnings_of(found))
    jsonschema.validate(whole, SCHEMA)
    json.dumps(whole, allow_nan=False)
    assert [one["verdict"] for one in whole["comparisons"]] == ["worse"] * 4 + ["too few"] * 4
    assert {one["outcome"] for one in whole["gates"]} == {"tripped"}
    first = whole["comparisons"][0]
    assert first["setting"]["payload"] == "raw"
    assert first["change"]["value"] == pytest.approx(first["ratio"]["value"] - 1)
    assert first["other"] / first["baseline"] == pytest.approx(first["ratio"]["value"])


def test_the_files_say_what_the_table_says(launch: Launch, tmp_path: Path) -> None:
    found = compared(launch(1), launch(2, factor=1.2), "e2e")
    table = compare_table(found)
    assert table.rows[0][0] == "e2e: median, ms"
    assert [row[0] for row in table.rows[1:]] == ["http/as-deployed", "http/binary", "ros/topic", "loopback"]
    assert all(row[-1] == "worse" and len(row) == len(table.header) for row in table.rows[1:])
    assert "Echo engine." in table.notes[0]
    written = write_comparison(tmp_path / "deep" / "out", found, {"a": 1})
    assert sorted(path.suffix for path in written) == [".csv", ".json", ".md", ".pdf", ".png", ".tex"]
    rows = list(csv.DictReader(io.StringIO(compare_csv(found))))
    assert float(rows[0]["ratio"]) == found.comparisons[0].change.ratio.value
    assert float(rows[3]["p_holm"]) == found.comparisons[3].p_holm


def test_the_figure_has_a_panel_a_metric_and_a_row_a_cell(launch: Launch) -> None:
    figure = build_forest(compared(launch(1), launch(2), "e2e", "capture"))
    assert [axes.get_title("left") for axes in figure.axes] == ["e2e.median", "capture.median"]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == list(CELLS)


@pytest.mark.parametrize(
    ("share", "text"), [(0.1, "+10"), (0.0994, "+9.9"), (-0.034, "-3.4"), (0.0, "0.0"), (-0.0004, "0.0"), (1.5, "+150")]
)
def test_a_change_is_written_in_per_cent(share: float, text: str) -> None:
    assert percent(share) == text
