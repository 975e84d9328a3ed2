"""Time against bytes: lines over the runs of a sweep, and the pictures of the page."""

from __future__ import annotations

from typing import Any

import pytest

from s2a_bench.experiments.latency.view.against_bytes import against_bytes, order_changes, shown
from s2a_bench.experiments.requests import RequestCells, cells_of
from s2a_bench.store.run import StoredRun
from s2a_bench.transport import TRANSPORTS
from s2a_bench.writers.figures import caption_of
from s2a_bench.writers.style import _OTHER_STYLES
from tests.made_runs import MakeRun

FIXED = {"http/binary": 1.0, "ros/topic": 0.2, "loopback": 0.1}
A_MB = {"http/binary": 0.3, "ros/topic": 0.9, "loopback": 0.2}


def settings(width: int, height: int, cameras: int, **more: Any) -> dict[str, Any]:
    return {"configuration": {"width": width, "height": height, "cameras": cameras, **more}}


def split(runs: list[StoredRun]) -> list[RequestCells]:
    return [cells_of(run) for run in runs]


@pytest.fixture
def runs(make_run: MakeRun) -> list[StoredRun]:
    made = []
    for width, height, cameras in ((224, 224, 1), (640, 480, 1), (640, 480, 3), (1920, 1080, 3)):
        pixels = width * height * 3 * cameras
        cells = {
            name: {"capture": FIXED[name] + A_MB[name] * pixels / 1e6, "inference": 5.0, "return": 0.0}
            for name in FIXED
        }
        payloads = {"http": "raw", "ros": "raw", "loopback": "none"}
        manifest = settings(width, height, cameras)
        made.append(make_run(cells, n=8, spread=0, manifest=manifest, payloads=payloads, payload_bytes=2 * pixels))
    return made


def test_lines_are_what_made_the_times(runs: list[StoredRun]) -> None:
    found = {each.name: each for each in against_bytes(split(runs))}
    assert list(found) == ["http/binary", "ros/topic", "loopback"]
    for name, each in found.items():
        assert each.line is not None
        assert (each.line.fixed.value, each.line.slope.value) == pytest.approx((FIXED[name], A_MB[name]), rel=1e-3)
        assert (each.payload, each.wire_share) == ("raw", 2.0)


LOADS = (1.0, 1.6, 0.7)
"""What slows every cell of a launch alike: far more than the two pipelines differ."""
WOBBLES = (0.9, 1.05, 1.1)


def launched(
    make_run: MakeRun, ratios: dict[int, float], *, launches: int = 3, together: bool = True, ingest: bool = False
) -> list[StoredRun]:
    """Measure ROS against HTTP at some widths; a ratio of 1 wobbles from launch to launch."""
    made = []
    for width, ratio in ratios.items():
        for load, wobble in list(zip(LOADS, WOBBLES, strict=True))[:launches]:
            off = wobble if ratio == 1 else wobble**0.2
            times = {"http/binary": width / 100 * load, "ros/topic": width / 100 * load * ratio * off}
            cells = {name: {"capture": ms, "inference": 1.0, "return": 0.0} for name, ms in times.items()}
            if ingest:
                cells["http/binary"] = {"ingest": 0.0, **cells["http/binary"]}
            parts = [cells] if together else [{name: each} for name, each in cells.items()]
            made += [make_run(part, n=5, spread=0, manifest=settings(width, 100, 1)) for part in parts]
    return made


def test_an_order_changes_between_the_measured_sizes_at_which_it_is_sure(make_run: MakeRun) -> None:
    runs = split(launched(make_run, {100: 0.7, 200: 0.8, 400: 1, 800: 1.3, 1600: 1.4}))
    ((one, other, (small, below), (large, above)),) = order_changes(against_bytes(runs))
    assert (one.name, other.name) == ("ros/topic", "http/binary")
    assert (small, large) == (200 * 300 / 1e6, 800 * 300 / 1e6)
    assert (below.value, above.value) == pytest.approx((0.8, 1.3), rel=0.02)
    table = shown(runs)[1]["crossings"]()
    assert table.rows[0] == (
        *("ros/topic, raw", "http/binary, raw"),
        *("0.060", "0.802 [0.761, 0.845]", "0.240", "1.30 [1.24, 1.37]"),
    )
    assert "Echo engine." in table.notes


@pytest.mark.parametrize(
    "unsure",
    [
        {"ratios": {100: 0.8, 200: 0.7}},
        {"ratios": {100: 0.8, 200: 1}},
        {"launches": 2},
        {"together": False},
        {"ingest": True},
    ],
    ids=["same order", "not known to differ", "two launches", "launches apart", "a black box"],
)
def test_no_order_changes_without_two_sizes_at_which_launches_tell_it(
    make_run: MakeRun, unsure: dict[str, Any]
) -> None:
    runs = split(launched(make_run, **{"ratios": {100: 0.8, 200: 1.3}} | unsure))
    assert order_changes(against_bytes(runs)) == []
    assert shown(runs)[1]["crossings"]() is None


def test_in_process_a_cell_stands_beside_each_payload(make_run: MakeRun) -> None:
    cells = {name: {"capture": 1.0, "inference": 1.0, "return": 0.0} for name in FIXED}
    payloads = {"http": "raw", "ros": "jpeg", "loopback": "none"}
    made = [
        make_run(cells, n=5, spread=0, manifest=settings(*size, 1), payloads=payloads)
        for size in ((64, 48), (640, 480))
    ]
    found = [(each.name, each.payload) for each in against_bytes(split(made))]
    assert found == [("http/binary", "raw"), ("loopback", "raw"), ("ros/topic", "jpeg"), ("loopback", "jpeg")]


def test_scaled_pictures_count_as_scaled(make_run: MakeRun) -> None:
    cells = {"ros/topic": {"capture": 1.0, "inference": 1.0, "return": 0.0}}
    sizes = [settings(640, 480, 1, resize=[224, 224]), settings(640, 480, 1)]
    made = [make_run(cells, n=5, spread=0, manifest=each, payloads={"ros": "raw"}) for each in sizes]
    ((pipeline),) = against_bytes(split(made))
    assert [*pipeline.sizes] == [224 * 224 * 3 / 1e6, 640 * 480 * 3 / 1e6]


def test_runs_of_one_size_show_nothing(make_run: MakeRun) -> None:
    same = [make_run(n=5, manifest=settings(640, 480, 1)) for _ in range(2)]
    assert against_bytes(split(same)) == []
    assert shown(split(same)) == ([], {}, {})
    assert against_bytes(split([make_run(n=5)])) == []  # a folder that says no size


def test_tables_and_figure_say_what_answered(runs: list[StoredRun]) -> None:
    (sentence,), tables, figures = shown(split(runs))
    assert sentence.startswith(
        "With raw pictures a megabyte of pixels takes 0.300 [0.300, 0.300] ms over http/binary to "
    )
    assert tables["crossings"]() is None  # one launch a size: no order
    assert tables["bytes"]().rows[0] == (
        *("http/binary", "raw", "1.00 [1.00, 1.00]", "0.300 [0.300, 0.300]", "2.00", "0%"),
    )
    assert "Echo engine." in tables["bytes"]().notes
    figure = figures["time_against_bytes"]()
    assert "Echo engine." in caption_of(figure)
    (axes,) = figure.axes
    assert [line.get_label() for line in axes.lines] == ["http/binary", "ros/topic", "loopback"]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")


def test_every_transport_looks_like_no_other() -> None:
    styles = [style for _, each in TRANSPORTS.loaded() for style in each.style.values()]
    assert len({*styles, *_OTHER_STYLES}) == len(styles) + len(_OTHER_STYLES)
