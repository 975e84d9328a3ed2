"""The boundary run: where naive execution is stall-free over tokens per skill and rate, by formula and by trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from s2a_bench.boards.profile import load_profile
from s2a_bench.boards.tokens import gaps_of
from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.rows import BOUNDARY, BoundaryRow, Duration
from s2a_bench.machine import environment
from s2a_bench.policy import Schedule
from s2a_bench.policy.arrivals import fragments, tokens
from s2a_bench.policy.conformal import ANY_STALL_S
from s2a_bench.policy.metrics import stalls
from s2a_bench.policy.schedule import work_conserving
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import RunWriter


def run_boundary(config: BoundaryConfig, output: Path, progress: Progress) -> Path:
    boards = [load_profile(name) for name in config.profiles]
    lengths = range(1, config.most_tokens + 1)
    rates = np.geomspace(config.rates[0], config.rates[1], config.rates_tried).tolist()
    computed = Provenance.computed()
    origins = {"": computed} | {board.name: board.provenance for board in boards}
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"plans": config.seed},
        "provenance": Origins(computed, origins).to_manifest(),
        "boards": [
            {"name": board.name, "title": board.title, "origin": board.origin, "tokens_per_s": board.tokens_per_s}
            for board in boards
        ],
    }
    with RunWriter.create(output, "boundary", manifest, (BOUNDARY,)) as writer:
        progress.opened(writer.path)
        progress.stage("trying every point")
        for duration in get_args(Duration):
            writer.append(BOUNDARY, rows(config, duration, lengths, rates))
            for board in boards:
                at_board = rows(config, duration, config.tokens_per_skill, [board.tokens_per_s], board.name)
                writer.append(BOUNDARY, at_board)
        return writer.path


def rows(
    config: BoundaryConfig, duration: Duration, lengths: Sequence[int], rates: Sequence[float], board: str = ""
) -> Iterator[BoundaryRow]:
    """Yield formula and trial of naive at every pair of L and R; one set of draws serves all: none differs by chance.

    Naive is stall-free iff S0 = t_1: for even tokens and equal durations T if L / R <= T, the paper's figure 2. The
    paper draws that line for T_min, but naive runs skills at T_nom. The prompt's time shifts all arrivals equally.
    """
    n_skills, plans, jitter = config.n_skills, config.plans_a_point, config.jitter
    duration_s = config.t_nom_s if duration == "t_nom" else config.t_min * config.t_nom_s
    durations_s = np.full((n_skills, 1), duration_s)
    rng = generator(config.seed, "boundary", board)
    token_s = tokens(gaps_of(jitter, 1.0), 0.0, max(lengths) * n_skills, plans, rng)
    for length in lengths:
        unit_s = fragments(token_s[: length * n_skills], length)
        for rate in rates:
            arrival_s = unit_s / rate
            naive = Schedule(work_conserving(arrival_s, durations_s, arrival_s[0]), durations_s)
            yield BoundaryRow(
                duration=duration,
                duration_s=duration_s,
                tokens_per_skill=length,
                tokens_per_s=rate,
                board=board,
                n_skills=n_skills,
                family=jitter,
                plans=plans,
                stall_free=length / duration_s <= rate,
                p_stall=float((stalls(naive) > ANY_STALL_S).any(axis=0).mean()),
            )
