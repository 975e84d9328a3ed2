"""What every figure of every experiment has: a caption that is not drawn, and one line that says where it is from."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from matplotlib.text import Text

from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.ccrb.config import CcrbComputed
from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.plugins.chunks.capacity.config import CapacityPredicted
from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
from s2a_bench.plugins.chunks.task.config import TaskVirtual
from s2a_bench.plugins.watch.config import WatchBag
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.testing import NullProgress
from s2a_bench.writers.figures import caption_of, source_line
from s2a_bench.writers.style import paper_column
from tests.made_bags import CAMERA, TOKENS, record, tokens

Make = Callable[[Path, Any], StoredRun]
FIGURES = {
    "boundary": ("boundary",),
    "capacity": ("capacity",),
    "ccrb": ("scenario", "phase"),
    "chunks": ("lanes", "stability", "triggers", "reactions"),
    "task": ("task",),
    "latency": ("stages", "latency_bars", "distribution"),
    "throughput": ("throughput_bars", "gaps", "positions"),
    "timeline": ("timeline",),
    "watch": ("cycles",),
}


def computed(name: str, config: Any, root: Path, _: Any) -> StoredRun:
    return read_run(EXPERIMENTS[name].run_with(config, root, NullProgress()))


def measured(name: str, _: Path, make_run: Any) -> StoredRun:
    llama = {"engine": "llama", "model": "tiny.gguf", "dummy": True}
    paced = Provenance.of_engine({**llama, "paced_tokens_per_s": 4.8}, link="real")
    origins = Origins(Provenance.of_engine(llama, link="real"), {"loopback": paced})
    cells = {"loopback": {"capture": 0.2, "inference": 100, "return": 0.2}}
    run: StoredRun = make_run(cells, n=3, engine="llama", manifest={"provenance": origins.to_manifest()})
    return StoredRun(run.path, {**run.manifest, "command": name}, run.tables)


def watched(root: Path, _: Any) -> StoredRun:
    return computed("watch", WatchBag(bag=record(root / "bag", tokens()), in_=CAMERA, out=TOKENS), root, _)


POLE: dict[str, Any] = {
    "robot": "gym?env=CartPole-v1&success=survival&picture=none",
    "engine": {"name": "echo", "action_dim": 1},
    "horizon": 1,
    "modes": "sync",
    "latency": "0,40,lognormal:mean_ms=30,cv=1",
    "episodes": 1,
    "steps": 3,
}
RUNS: dict[str, Make] = {
    "boundary": partial(computed, "boundary", BoundaryConfig(points=5, most_tokens=3)),
    "capacity": partial(computed, "capacity", CapacityPredicted(predict="40", robots="1..2", seconds=1)),
    "ccrb": partial(computed, "ccrb", CcrbComputed(phase=True, phase_points=(3, 2))),
    "chunks": partial(computed, "chunks", ChunksVirtual(cycles=50)),
    "latency": partial(measured, "latency"),
    "task": partial(computed, "task", TaskVirtual(**POLE)),
    "throughput": partial(measured, "throughput"),
    "timeline": partial(computed, "timeline", TimelineComputed(profiles=("jetson-agx-orin",), tokens_per_skill=(6,))),
    "watch": watched,
}
EMULATED, DUMMY = "no engine, tokens EMULATED, virtual time", "llama (DUMMY WEIGHTS), tokens PACED"
SEEN = "engine UNKNOWN (the server does not report it), RECORDED, link UNKNOWN"
LINES = {"watch": SEEN, "latency": DUMMY, "throughput": DUMMY, "task": "echo (no model), tokens EMULATED, virtual time"}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_figure_has_one_line_of_provenance_and_a_caption(name: str, tmp_path: Path, make_run: Any) -> None:
    run = RUNS[name](tmp_path, make_run)
    host, day = run.manifest["host"], run.manifest["started"][:10]
    with paper_column():
        figures = {each: build() for each, build in EXPERIMENTS[name].show(run).figures.items()}
    assert tuple(figures) == FIGURES[name]
    for figure in figures.values():
        line = figure.get_suptitle()
        assert line == f"{LINES.get(name, EMULATED)} · {host} · {day}"
        title, *notes, origin = caption_of(figure)
        assert title
        assert not title.endswith(".")
        assert all(note.endswith((".", "!")) for note in notes)
        assert origin == run.origins.line
        assert not any(title in text.get_text() for text in figure.findobj(Text))


def test_the_line_stays_one_line_and_fits_whatever_answered(make_run: Any) -> None:
    names = [f"engine-{place}" for place in range(6)]
    cells = {name: Provenance(name, weights="dummy", tokens="paced", link="emulated") for name in names}
    facts = {"provenance": Origins(Provenance(), cells).to_manifest(), "host": "a$b$c"}
    run = make_run(n=3)
    run = StoredRun(run.path, {**run.manifest, **facts}, run.tables)
    with paper_column():
        figure = EXPERIMENTS["latency"].show(run).figures["latency_bars"]()
    assert all(name in figure.get_suptitle() for name in (*names, "a$b$c", "DUMMY WEIGHTS", "PACED", "link EMULATED"))
    figure.draw_without_rendering()
    assert figure.get_tightbbox().x1 <= figure.get_figwidth()


def test_what_a_manifest_does_not_say_is_left_out() -> None:
    assert source_line([StoredRun(Path(), {})]) == "engine UNKNOWN (the server does not report it), link UNKNOWN"
