"""The boundary run: where naive execution is stall-free over tokens per skill and rate, by formula and by trial."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.boards.profile import Profile
from s2a_bench.boards.search import load_profile
from s2a_bench.errors import UsageError
from s2a_bench.experiments.boundary.rows import BOUNDARY, BoundaryRow
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.experiments.timeline.plans import NO_JITTER, gaps_of
from s2a_bench.harness.ranges import require
from s2a_bench.machine import environment
from s2a_bench.policy.boundary import Grid, analytic, simulate
from s2a_bench.policy.conformal import TOLERANCE_S
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.harness.progress import Progress

PLANS: Final = 2000
"""Plans a point with jitter; without, one tells all."""
MARKS, SHADES = 25, 73
"""Rates of a grid whose points are drawn one by one, or as shades."""


@dataclass(frozen=True)
class BoundaryConfig:
    """Which plane is drawn."""

    profiles: tuple[str, ...] = ("rtx-4080", "jetson-agx-orin", "jetson-orin-nano")
    tokens_per_skill: tuple[int, ...] = (6, 4, 2, 1)
    """Where the boards are marked."""
    most_tokens: int = 8
    """The grid has L = 1 ... this."""
    rates: tuple[float, ...] = (0.3, 60.0)
    points: int | None = None
    """Rates of the grid, at even steps of a logarithmic axis; None: `MARKS`, with jitter `SHADES`."""
    n_skills: int = 8
    t_nom_s: float = 1.0
    t_min: float = 0.8
    """T_min over T_nom."""
    jitter: str = NO_JITTER
    plans: int | None = None
    seed: int = 0

    @cached_property
    def boards(self) -> list[Profile]:
        """Read the profiles; raises UsageError for one that there is not."""
        return [load_profile(name) for name in self.profiles]

    @property
    def durations(self) -> dict[str, float]:
        """Return what a skill may take, in s: as naive runs it, and at the least."""
        return {"t_nom": self.t_nom_s, "t_min": self.t_min * self.t_nom_s}

    @property
    def grid(self) -> Grid:
        """Return the plane's points."""
        rates = np.geomspace(self.rates[0], self.rates[-1], self.rates_tried)
        return Grid(tuple(range(1, self.most_tokens + 1)), tuple(float(rate) for rate in rates))

    @property
    def rates_tried(self) -> int:
        """Return how many rates the grid has."""
        return self.points if self.points is not None else MARKS if self.jitter == NO_JITTER else SHADES

    @property
    def plans_a_point(self) -> int:
        """Return how many plans are tried at each point."""
        return self.plans if self.plans is not None else 1 if self.jitter == NO_JITTER else PLANS

    def check(self) -> None:
        """Refuse what makes no sense; raises UsageError naming the flag."""
        if len(self.rates) != 2 or not self.rates[0] < self.rates[1]:  # noqa: PLR2004 - from, to
            raise UsageError("--rates: should be two tokens/s, the lower first, as 0.3,60")
        require("--rates", self.rates, 0, above=True)
        require("--points", [self.rates_tried], 2, 1000)
        require("--most-tokens", [self.most_tokens], 1, 1000)
        require("--tokens-per-skill", self.tokens_per_skill, 1, 1000)
        require("--n-skills", [self.n_skills], 2, 10_000)
        require("--t-nom", [self.t_nom_s], 0, above=True)
        require("--t-min (a factor of T_nom)", [self.t_min], 0, 1, above=True)
        require("--plans", [self.plans_a_point], 1, 1_000_000)
        require("--seed", [self.seed], 0)
        if self.jitter == NO_JITTER and self.plans_a_point > 1:
            raise UsageError("--plans: without --jitter all plans are the same; leave it out")
        gaps_of(self.jitter, 1.0)


def run_boundary(config: BoundaryConfig, output: Path, progress: Progress) -> Path:
    """Compute the plane and return the run folder; raises S2AError for what a user can mend."""
    config.check()
    manifest = {
        "configuration": {**asdict(config), "plans": config.plans_a_point, "points": config.rates_tried},
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "boards": [
            {"name": board.name, "title": board.title, "origin": board.origin, "tokens_per_s": board.tokens_per_s}
            for board in config.boards
        ],
    }
    with RunWriter.create(output, "boundary", manifest, (BOUNDARY,)) as writer:
        progress.opened(writer.path)
        progress.stage("trying every point")
        for name in config.durations:
            writer.append(BOUNDARY, rows(config, name, config.grid))
            for board in config.boards:
                marks = Grid(config.tokens_per_skill, (board.tokens_per_s,))
                writer.append(BOUNDARY, rows(config, name, marks, board.name))
        return writer.path


def rows(config: BoundaryConfig, duration: str, grid: Grid, board: str = "") -> Iterator[BoundaryRow]:
    """Ask formula and trial at every point; all points of a grid share their draws."""
    duration_s = config.durations[duration]
    free = analytic(grid, duration_s)
    share = simulate(
        grid,
        gaps_of(config.jitter, 1.0),
        n_skills=config.n_skills,
        duration_s=duration_s,
        plans=config.plans_a_point,
        rng=generator(config.seed, "boundary", board),
        tolerance_s=TOLERANCE_S,
    )
    for row, tokens in enumerate(grid.tokens_per_skill):
        for column, rate in enumerate(grid.tokens_per_s):
            yield BoundaryRow(
                duration=duration,
                duration_s=duration_s,
                tokens_per_skill=tokens,
                tokens_per_s=rate,
                board=board,
                n_skills=config.n_skills,
                family=config.jitter,
                plans=config.plans_a_point,
                stall_free=bool(free[row, column]),
                p_stall=float(share[row, column]),
            )
