"""Draw figures of docs/{policies,timeline,boundary,chunks,capacity,ccrb}.md: `.venv/bin/python tools/docs_figures.py`.

They come from runs in virtual time with fixed seeds, so that running this again changes no figure. Those of the
studies are drawn by `python -m studies figures`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.run import run_boundary
from s2a_bench.experiments.ccrb.config import CcrbClosedLoop
from s2a_bench.experiments.ccrb.run import run_closed_loop
from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.experiments.timeline.view.figures import policy_colours
from s2a_bench.plugins.chunks.capacity.config import CapacityPredicted
from s2a_bench.plugins.chunks.capacity.predict import run_predicted
from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
from s2a_bench.plugins.chunks.chunks.run import run_virtual
from s2a_bench.policy.arrivals import uniform
from s2a_bench.policy.schedule import safe_start, work_conserving
from s2a_bench.progress import NullProgress
from s2a_bench.scenario import SIMULATORS, DriveCommand
from s2a_bench.store.run import StoredRun, read_run
from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.style import paper_column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = Path(__file__).parent.parent / "docs" / "figures"
DPI = 150
ORIN = TimelineComputed(profiles=("jetson-agx-orin",), tokens_per_skill=(6,))


SPREAD = "lognormal:mean_ms=80,cv=0.5"
SLOW_ONES = "bimodal:mean_ms=80,cv=0.2,pause_share=0.05,pause_ratio=3"


def timelines(config: TimelineComputed) -> Figure:
    """Draw a timeline run."""
    return drawn(_run(lambda output: run_timeline(config, output, QUIET)), "timeline")


def boundary(config: BoundaryConfig) -> Figure:
    """Draw a boundary run."""
    return drawn(_run(lambda output: run_boundary(config, output, QUIET)), "boundary")


def chunks(latency: str) -> StoredRun:
    """Make a run of chunks, four modes and the rules."""
    return _run(lambda output: run_virtual(ChunksVirtual(latency=latency, shown_ticks=90), output, QUIET))


def safe_start_figure() -> Figure:
    """Draw why S0 is where it is: arrivals as points, and when each skill starts under three first moves."""
    arrival_s = uniform(0.5, 6, 4.8, 8)
    nominal_s = np.ones_like(arrival_s)
    safe_s = float(safe_start(arrival_s, nominal_s)[0])
    naive_s = work_conserving(arrival_s, nominal_s, arrival_s[0])
    skills = np.arange(1, 9)
    colours = policy_colours()
    figure = new_figure(2.5, ("When skill i starts, and when it has arrived",))
    figure.suptitle("computed: L = 6, R = 4.8 tokens/s, T = 1 s, c = 0.5 s", x=0.01, ha="left", color="#444444")
    axes = figure.subplots()
    axes.fill_betweenx(skills, 0, arrival_s[:, 0], color="#EEEEEE", linewidth=0, label="not arrived yet")
    axes.plot(naive_s[:, 0], skills, "o-", color=colours["naive"], markersize=6, label="naive: starts on arrival")
    early_s = safe_s - 1 + skills - 1
    axes.plot(early_s, skills, ":", color="#666666", label=f"without a stall from {safe_s - 1:g} s: impossible")
    axes.plot(
        safe_s + skills - 1,
        skills,
        "s-",
        color=colours["stream-to-act"],
        markersize=4,
        label=f"from $S_0$ = {safe_s:g} s",
    )
    axes.plot(arrival_s[:, 0], skills, "k|", markersize=9, label="arrival $t_i$")
    axes.set_xlim(0, 11.5)
    axes.set_ylim(0.6, 8.4)
    axes.set_yticks(skills)
    axes.set_xlabel("time from the request (s)")
    axes.set_ylabel("skill i")
    figure.legend(loc="outside lower center", ncols=2, columnspacing=1.0)
    return figure


def windscreen_figure() -> Figure:
    """Draw what the model is asked about: the lead at 40 m, and at 12 m while it brakes."""
    figure = new_figure(1.7, ("The ego's view of the lead",))
    world = SIMULATORS["longitudinal"]()
    camera = world.camera(640, 480)
    for axes, gap_m, lead_mps2 in zip(figure.subplots(1, 2), (40.0, 12.0), (0.0, -6.0), strict=True):
        world.place(np.array([[gap_m], [0.0], [-14.0]]), np.full((3, 1), 50 / 3.6))
        world.step(DriveCommand(np.array([[lead_mps2], [0.0], [0.0]]), np.array([0])))
        axes.imshow(camera.read().data[..., ::-1])
        axes.set_title(f"gap {gap_m:g} m, lead {lead_mps2:g} m/s\N{SUPERSCRIPT TWO}")
        axes.axis("off")
    return figure


QUIET = NullProgress()
RUNS = TemporaryDirectory()
"""Where runs are until all is drawn: their tables are read when they are needed."""


def _run(make: Callable[[Path], Path]) -> StoredRun:
    """Make a run in a folder that goes again; virtual time is the same on every host and day."""
    run = read_run(make(Path(RUNS.name)))
    return replace(run, manifest={name: run.manifest[name] for name in run.manifest if name not in {"host", "started"}})


def drawn(run: StoredRun, name: str) -> Figure:
    """Draw a figure of a run as its experiment does."""
    return EXPERIMENTS[str(run.manifest["command"])].show(run).figures[name]()


FIGURES: dict[str, Callable[[], Figure]] = {
    "policies": lambda: timelines(ORIN),
    "safe-start": safe_start_figure,
    "online": lambda: timelines(
        ORIN.but(policies=("naive", "s2a-clairvoyant", "s2a-mean", "stream-to-act"), jitter="profile")
    ),
    "timeline": lambda: timelines(TimelineComputed()),
    "windscreen": windscreen_figure,
    "boundary": lambda: boundary(BoundaryConfig()),
    "boundary-jitter": lambda: boundary(BoundaryConfig(jitter="lognormal:cv=0.2")),
    "capacity": lambda: drawn(
        _run(lambda output: run_predicted(CapacityPredicted(predict="25"), output, QUIET)), "capacity"
    ),
    "closed-loop": lambda: drawn(_run(lambda output: run_closed_loop(CcrbClosedLoop(), output, QUIET)), "scenario"),
    "chunks-lanes": lambda: drawn(chunks(SPREAD), "lanes"),
    "chunks-stability": lambda: drawn(chunks(SPREAD), "stability"),
    "chunks-triggers": lambda: drawn(chunks(f"{SPREAD},{SLOW_ONES}"), "triggers"),
    "chunks-reactions": lambda: drawn(chunks("80"), "reactions"),
}


def main() -> None:
    """Draw all of them, or those that are named."""
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or FIGURES:
        with paper_column():
            FIGURES[name]().savefig(FOLDER / f"{name}.png", dpi=DPI)
        print(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
