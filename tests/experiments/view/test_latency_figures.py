import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from s2a_bench.experiments import write_shown
from s2a_bench.experiments.latency import EXPERIMENT
from s2a_bench.experiments.latency.view.figures import latency_figures
from s2a_bench.experiments.requests import cells_of
from s2a_bench.store.run import StoredRun
from s2a_bench.writers.figures import Bar, caption_of
from s2a_bench.writers.style import GREY, PAGE_IN, paper_column
from tests.made_runs import MakeRun

HAND = {
    "http/as-deployed": {"capture": 1, "image_encode": 3, "network": 2, "inference": 100, "": 1.5, "return": 0.5},
    "ros/topic": {"capture": 1, "cdr_pack": 0.5, "network": 2, "inference": 100, "return": 0.5},
}


@pytest.fixture(autouse=True)
def style() -> Iterator[None]:
    with paper_column():
        yield


def drawn(name: str, run: StoredRun, against: str = "") -> Figure:
    return latency_figures(cells_of(run), against)[name]()


def row_names(figure: Figure) -> list[str]:
    return [label.get_text() for label in figure.axes[0].get_yticklabels()]


def bars(figure: Figure, panel: int = 0) -> list[Rectangle]:
    return [patch for patch in figure.axes[panel].patches if isinstance(patch, Rectangle)]


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for found in figure.legends for text in found.get_texts()]


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].texts]


def test_bars_are_medians_and_whiskers_are_seen_on_every_colour(make_run: MakeRun) -> None:
    figure = drawn("latency_bars", make_run(HAND, n=4, spread=0))
    assert row_names(figure) == ["http/as-deployed\n(raw)", "ros/topic\n(raw)"]
    assert [bar.get_width() for bar in bars(figure)] == [8.0, 4.0]
    assert texts(figure) == ["8.00", "4.00"]
    assert all(line.get_path_effects() for line in figure.axes[0].get_lines())
    assert Bar.of("skewed", np.array([1.0, 2.0, 12.0]), GREY) == Bar("skewed", 2.0, (1.2, 10.0), "2.00")
    assert figure.axes[0].get_xlim()[0] == 0
    assert figure.axes[0].get_xlabel() == "e2e without inference (ms)"
    assert legend(figure) == []


def test_the_papers_values_appear_only_when_asked_for_and_as_another_machines(make_run: MakeRun) -> None:
    run = make_run(HAND, n=4, spread=0)
    assert "paper" not in "".join(row_names(drawn("latency_bars", run)))
    figure = drawn("latency_bars", run, against="paper")
    assert row_names(figure)[2:] == ["paper:\nHTTP/JSON", "paper:\nROS-native"]
    assert [bar.get_width() for bar in bars(figure)][2:] == [101.8, 15.5]
    assert {mpl.colors.to_hex(bar.get_facecolor()).upper() for bar in bars(figure)[2:]} == {GREY}
    assert texts(figure)[2:] == ["101.8 ± 8.6", "15.5 ± 1.0"]
    assert legend(figure) == ["paper (Jetson AGX Orin), another machine"]
    assert any("does not say that inference is left out" in note for note in caption_of(figure))


def test_the_stacked_groups_are_medians_beside_that_of_the_whole(make_run: MakeRun) -> None:
    figure = drawn("stages", make_run(HAND, n=4, spread=0))
    assert len(figure.axes) == 1
    assert legend(figure) == ["capture", "encode", "pack", "network", "return", "residual", "whole"]
    parts = bars(figure)
    assert [bar.get_width() for bar in parts[:6]] == [1, 3, 0, 2, 0.5, 1.5]
    assert [bar.get_x() for bar in parts[:6]] == [0, 1, 4, 4, 6, 6.5]
    assert parts[5].get_hatch() == "//////"
    assert texts(figure) == ["8.00", "4.00"]
    assert [list(line.get_xdata()) for line in figure.axes[0].get_lines()] == [[8, 8], [4, 4]]


def test_cells_that_differ_widely_get_a_panel_of_shares(make_run: MakeRun) -> None:
    small = {"loopback": {"capture": 0.2, "inference": 100, "return": 0.2}}
    figure = drawn("stages", make_run(HAND | small, n=4, spread=0))
    assert [axes.get_xlabel() for axes in figure.axes] == ["e2e without inference (ms)", "share (%)"]
    ends = [bar.get_x() + bar.get_width() for bar in bars(figure, 1) if bar.get_hatch() == "//////"]
    assert ends == pytest.approx([100, 100, 100])
    capture = [bar.get_width() for bar in bars(figure, 1)][::6]
    assert capture == pytest.approx([12.5, 25, 50])
    with paper_column(PAGE_IN):
        beside = drawn("stages", make_run(HAND | small, n=4, spread=0))
    assert beside.axes[0].get_position().y0 == beside.axes[1].get_position().y0
    assert row_names(beside)[0] == "http/as-deployed (raw)"


def test_a_black_box_is_left_out_by_name_or_shown_with_its_inference(make_run: MakeRun, black_box: Any) -> None:
    mixed = drawn("latency_bars", make_run(HAND | {"http/black-box": black_box}, n=4))
    assert "http/black-box not shown (inference unknown)" in " ".join(caption_of(mixed))
    assert len(bars(mixed)) == 2
    alone = drawn("stages", make_run({"http/black-box": black_box}, n=4, spread=0))
    assert alone.axes[0].get_xlabel() == "e2e, inference included (ms)"
    assert "server" in legend(alone)


@pytest.mark.parametrize("count", [1, 5])
def test_no_text_is_clipped_or_smaller_than_seven_points(
    make_run: MakeRun, plausible: dict[str, Any], count: int
) -> None:
    run = make_run(dict(list(plausible.items())[:count]), n=10)
    for figure in (drawn("latency_bars", run, against="paper"), drawn("stages", run), drawn("distribution", run)):
        figure.draw_without_rendering()
        inked = figure.get_tightbbox()
        assert min(inked.x0, inked.y0) >= 0
        assert inked.x1 <= figure.get_figwidth()
        assert inked.y1 <= figure.get_figheight()
        assert all(text.get_fontsize() >= 7 for text in figure.findobj(mpl.text.Text))
        assert figure.get_figwidth() == 3.5


def test_figures_are_written_with_their_captions_and_leave_no_global_state(make_run: MakeRun) -> None:
    run = make_run(n=3)
    before = dict(mpl.rcParams)
    write_shown(run, EXPERIMENT.show(run, against="paper"))
    assert dict(mpl.rcParams) == before
    (captions,) = (run.path / "figures").glob("*.md")
    assert captions.read_text().startswith("**stages**: Stages, medians: end to end without inference. n = 3 a cell")


def test_only_views_writers_and_report_import_matplotlib() -> None:
    root = Path(__file__).parents[3] / "s2a_bench"
    typed = {("experiments", "__init__.py"), ("library.py",)}  # where a type is named, and nothing is imported
    importers = [path for path in root.rglob("*.py") if re.search(r"(import|from) matplotlib", path.read_text())]
    allowed = {"writers", "report", "view", "view.py"}
    places = {path.relative_to(root).parts for path in importers} - typed
    assert {parts for parts in places if not allowed & {*parts}} == set()
