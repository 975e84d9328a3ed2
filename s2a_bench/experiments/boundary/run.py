"""The boundary run: where naive execution is stall-free over tokens per skill and rate, by formula and by trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from s2a_bench.boards.tokens import gaps_of
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.rows import BOUNDARY, BoundaryRow
from s2a_bench.machine import environment
from s2a_bench.policy import Schedule
from s2a_bench.policy.arrivals import fragments, tokens
from s2a_bench.policy.conformal import ANY_STALL_S
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import work_conserving
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
            writer.append(BOUNDARY, rows(config, name, *config.grid))
            for board in config.boards:
                writer.append(BOUNDARY, rows(config, name, config.tokens_per_skill, [board.tokens_per_s], board.name))
        return writer.path


def rows(
    config: BoundaryConfig, duration: str, tokens_per_skill: Sequence[int], rates: Sequence[float], board: str = ""
) -> Iterator[BoundaryRow]:
    """Yield formula and trial at every pair of L and R; one set of draws serves all, so that none differs by chance.

    Naive is stall-free iff S0 = t_1: for even tokens and equal durations T if L / R <= T, the paper's figure 2. The
    paper draws that line for T_min, but naive runs skills at T_nom. The prompt's time shifts all arrivals equally.
    """
    duration_s = config.durations[duration]
    durations_s = np.full((config.n_skills, 1), duration_s)
    gaps, count = gaps_of(config.jitter, 1.0), max(tokens_per_skill) * config.n_skills
    token_s = tokens(gaps, 0.0, count, config.plans_a_point, generator(config.seed, "boundary", board))
    for length in tokens_per_skill:
        unit_s = fragments(token_s[: length * config.n_skills], length)
        for rate in rates:
            arrival_s = unit_s / rate
            naive = Schedule(work_conserving(arrival_s, durations_s, arrival_s[0]), durations_s)
            yield BoundaryRow(
                duration=duration,
                duration_s=duration_s,
                tokens_per_skill=length,
                tokens_per_s=rate,
                board=board,
                n_skills=config.n_skills,
                family=config.jitter,
                plans=config.plans_a_point,
                stall_free=length / duration_s <= rate,
                p_stall=float((stalls(naive) > ANY_STALL_S).any(axis=0).mean()),
            )
