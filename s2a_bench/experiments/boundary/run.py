"""The boundary run: where naive execution is stall-free over tokens per skill and rate, by formula and by trial."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.boards.tokens import gaps_of
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.rows import BOUNDARY, BoundaryRow
from s2a_bench.machine import environment
from s2a_bench.policy.conformal import ANY_STALL_S
from s2a_bench.policy.evaluate import Grid, analytic, simulate
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress


def run_boundary(config: BoundaryConfig, output: Path, progress: Progress) -> Path:
    grid = Provenance.computed()
    boards = {board.name: board.provenance for board in config.boards}
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "provenance": Origins(grid, {"": grid} | boards).to_manifest(),
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
    """Yield formula and trial at every point; all points of a grid share their draws."""
    duration_s = config.durations[duration]
    free = analytic(grid, duration_s)
    share = simulate(
        grid,
        gaps_of(config.jitter, 1.0),
        n_skills=config.n_skills,
        duration_s=duration_s,
        plans=config.plans_a_point,
        rng=generator(config.seed, "boundary", board),
        tolerance_s=ANY_STALL_S,
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
