"""The sentences, table, figure, JSON and comparison of capacity runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.plugins.chunks.capacity import EXPERIMENT
from s2a_bench.plugins.chunks.capacity.config import CapacityPredicted
from s2a_bench.plugins.chunks.capacity.predict import run_predicted
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, KNEES, ROBOTS
from s2a_bench.report.compare.comparison import compare, metrics_of, open_comparison
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.writers.style import paper_column

STALLED = "at most 1 % stalled ticks"


def predict(tmp_path: Path, service_ms: int = 40, **options: Any) -> Path:
    config = CapacityPredicted(predict=str(service_ms), robots="1..64", seconds=10, **options)
    return run_predicted(config, tmp_path, NullProgress())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return predict(tmp_path_factory.mktemp("capacity"))


def measured(folder: Path, driven: int = 16) -> StoredRun:
    """Return a predicted run, beside which its fleets are also measured ones with the same values but of 9 robots."""
    run = read_run(folder)
    fleets, knees = run.table(FLEETS), run.table(KNEES)
    own = fleets.assign(source="measured")
    own.loc[own["robots"] == 9, ["stalled_low", "stalled_high"]] = 0.9, 1.0
    twin = fleets.assign(cell="40, instant, queue?trigger=8", source="twin")
    twin = twin[twin["robots"] >= driven].assign(within=twin["robots"] <= driven)
    run.tables[FLEETS.name] = type(fleets)(own.to_dict("records") + fleets.to_dict("records") + twin.to_dict("records"))
    run.tables[KNEES.name] = type(knees)(
        knees.assign(source="measured", driven=16, low=7).to_dict("records") + knees.to_dict("records")
    )
    robot = fleets.drop(columns=["seconds", "looks", "verdict", "within", "clean"])
    run.tables[ROBOTS.name] = robot.assign(source="measured", robot=0)
    return run


def test_the_sentence_names_the_knee_its_interval_and_what_it_holds_for(folder: Path) -> None:
    shown = EXPERIMENT.show(measured(folder))
    assert list(shown.sentences) == [
        f"8 robots [7, 8] at 50 Hz, H 16, 40, queue?trigger=8, with {STALLED}.",
        f"predicted: 8 robots at 50 Hz, H 16, 40, queue?trigger=8, with {STALLED}; service times: as given.",
        "40, queue?trigger=8: the interval of the measured share of stalls does not hold the predicted one at 9 robots.",  # noqa: E501
    ]


def test_fleets_stand_by_their_number_of_robots_however_they_were_searched(folder: Path) -> None:
    shown = EXPERIMENT.show(measured(folder))
    table = shown.tables["capacity"]
    robots = [int(row[2]) for row in table.rows]
    assert robots == [1, 2, 4, 8, 9, 10, 12, 16] * 2 + [16]
    stalled = [row[table.header.index("stalled, %")] for row in table.rows]
    assert stalled[0].startswith("0.000 [0.000, ")
    assert stalled[8] == "0.000", "predicted"
    found = shown.json()
    assert [cell["robots"] for cell in found["cells"]] == robots
    assert [knee["robots"] for knee in found["knees"]] == [8, 8]
    json.dumps(found)


def test_a_fleet_whose_generator_was_late_is_no_measurement_in_table_and_sentence(folder: Path) -> None:
    run = measured(folder)
    fleets = run.table(FLEETS)
    run.tables[FLEETS.name] = fleets.assign(clean=(fleets["robots"] != 9) | (fleets["source"] != "measured"))
    shown = EXPERIMENT.show(run)
    table = shown.tables["capacity"]
    assert [row[2] for row in table.rows if row[3] == "late"] == ["9"]
    assert table.notes == (
        "late: no measurement, as the generator missed its ticks, or exceeds the limit even with an instant server",
    )
    assert list(shown.sentences)[2].endswith("stalls holds the predicted one at 1, 2, 4, 8, 10, 12, 16 robots.")


def test_a_fleet_that_the_generator_does_not_drive_by_its_twin_is_no_measurement_anywhere(folder: Path) -> None:
    run = measured(folder, driven=8)
    shown = EXPERIMENT.show(run)
    late = [(row[1], int(row[2])) for row in shown.tables["capacity"].rows if row[3] == "late"]
    assert late == [("", robots) for robots in (9, 10, 12, 16)]
    assert [cell["clean"] for cell in shown.json()["cells"][:8]] == [True] * 4 + [False] * 4
    (csv,) = shown.csvs.values()
    assert [row[csv.header.index("clean")] for row in csv.rows[:8]] == [True] * 4 + [False] * 4
    with paper_column():
        stalled = shown.figures["capacity"]().axes[1]
    drawn = [max(line.get_xdata()) for line in stalled.lines if line.get_marker() == "." and len(line.get_xdata())]
    assert drawn == [8, 16], "measured, predicted"
    compared = open_comparison([run], [run], unlike=True, least=0.05)
    names = [each.pair.name for each in compare(compared, metrics_of(compared, ["stalled"])).comparisons]
    assert names == [f"40, queue?trigger=8, {robots} robots" for robots in (1, 2, 4, 8)]


def test_without_a_fleet_that_was_driven_there_is_no_figure(folder: Path) -> None:
    run = measured(folder)
    run.tables[FLEETS.name] = run.table(FLEETS).assign(clean=False)
    assert EXPERIMENT.show(run).figures == {}


@pytest.mark.parametrize(
    ("knee", "sentence"),
    [
        ({"robots": 0, "low": 0, "high": 0}, "no robot at"),
        ({"robots": 0, "low": 0, "high": None}, "0 robots [0, ...] at"),
        ({"robots": 1, "low": 0, "high": 3}, "1 robot [0, 3] at"),
        ({"source": "predicted", "robots": 0, "low": 0, "high": 0}, "predicted: no robot at"),
        ({"source": "predicted", "robots": 1, "low": 1, "high": 3}, "predicted: 1 robot, fewer than 4, at"),
        ({"source": "predicted", "robots": 8, "low": 8, "high": None}, "predicted: 8 robots or more at"),
    ],
)
def test_no_robot_is_said_where_one_was_too_many(folder: Path, knee: dict[str, Any], sentence: str) -> None:
    run = measured(folder)
    run.tables[KNEES.name] = run.table(KNEES).iloc[:1].assign(**knee)
    assert next(iter(EXPERIMENT.show(run).sentences)).startswith(sentence)


def test_the_sentence_about_plans_names_how_often_they_are_wanted(tmp_path: Path) -> None:
    run = read_run(predict(tmp_path, 250, plan_every_s=1.0))
    assert list(EXPERIMENT.show(run).sentences) == [
        "predicted: 4 robots with a plan every 1 s, 250, with at most 1 % stalled plans; service times: as given."
    ]


def test_a_panel_has_the_values_of_its_fleets(folder: Path) -> None:
    run = read_run(folder)
    rows = sorted(run.table(FLEETS).to_dict("records"), key=lambda row: row["robots"])
    with paper_column():
        latency, stalled, age = EXPERIMENT.show(run).figures["capacity"]().axes
    for axes, column, factor in (
        (latency, "latency_p50_ns", 1e-6),
        (stalled, "stalled", 100),
        (age, "age_p50_ns", 1e-6),
    ):
        line = next(each for each in axes.lines if each.get_marker() == "." and len(each.get_xdata()))
        assert [*line.get_xdata()] == [row["robots"] for row in rows]
        assert [*line.get_ydata()] == pytest.approx([row[column] * factor for row in rows])
    thin = next(each for each in latency.lines if each.get_marker() == "" and len(each.get_xdata()) > 2)
    assert [*thin.get_ydata()] == pytest.approx([row["latency_p99_ns"] / 1e6 for row in rows])


def test_the_time_to_the_first_piece_is_shown_of_answers_that_stream(tmp_path: Path) -> None:
    for options, shown in (({}, False), ({"plan_every_s": 1.0}, True)):
        run = read_run(predict(tmp_path, **options))
        rows = run.table(FLEETS).assign(ttft_p99_ns=5_000_000)
        run.tables[FLEETS.name] = type(rows)(rows.to_dict("records"))
        header = EXPERIMENT.show(run).tables["capacity"].header
        assert any("first" in title.lower() or "ttft" in title.lower() for title in header) == shown


@pytest.mark.parametrize("service", [None, "as given"])
def test_runs_of_before_have_one_service_for_all_cells_or_none(folder: Path, service: str | None) -> None:
    run = read_run(folder)
    del run.manifest["service"]
    run.manifest.update({"service": service} if service else {})
    (sentence,) = EXPERIMENT.show(run).sentences
    assert sentence.endswith("stalled ticks; service times: as given." if service else "stalled ticks.")


@pytest.mark.parametrize(
    ("options", "panels"),
    [
        ({}, ["latency (ms)", "stalled (%)", "age of action (ms)"]),
        ({"closed_loop": True, "limit": "latency_p99=300ms"}, ["latency (ms)"]),
    ],
)
def test_a_figure_has_a_panel_for_what_its_robots_have(
    tmp_path: Path, options: dict[str, Any], panels: list[str]
) -> None:
    with paper_column():
        figure = EXPERIMENT.show(read_run(predict(tmp_path, **options))).figures["capacity"]()
    assert [axes.get_ylabel() for axes in figure.axes] == panels


def test_knees_of_two_runs_are_compared(folder: Path, tmp_path: Path) -> None:
    runs = measured(folder), read_run(predict(tmp_path, modes=("queue?trigger=8", "sync")))
    compared = open_comparison(runs[:1], runs[1:], unlike=True, least=0.05)
    found = compare(compared, metrics_of(compared, ["knee"])).comparisons
    assert [(each.pair.name, each.change.baseline, each.change.other) for each in found] == [
        ("40, queue?trigger=8, predicted", 8, 8)
    ]
