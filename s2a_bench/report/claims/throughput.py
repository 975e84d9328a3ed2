"""What the paper's table II is judged by: tokens a second of its model on its boards."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.paper import paper_throughput
from s2a_bench.report.claims.claim import CONTRADICTED, UNDECIDED, Claim, Need, Part, Said
from s2a_bench.report.claims.intervals import LIKE, change, near
from s2a_bench.report.claims.needs import PAPERS_MODEL, QUANTISATION, on_board
from s2a_bench.stats import summarise
from s2a_bench.writers.tables import mean_sd

if TYPE_CHECKING:
    from collections.abc import Iterator

    from s2a_bench.experiments.paper import PaperThroughput
    from s2a_bench.store.run import Run

_METRIC: Final = "tokens_per_s"


def _speeds(run: Run) -> Iterator[Part]:
    from s2a_bench.experiments.throughput.view.cells import speeds_of

    for speed in speeds_of(run):
        if speed.values(_METRIC).size:
            yield Part(run, speed.name, speed, (run.origins.of(speed.name),))


_T_EVAL: Final = Need(
    "T_eval", "the engine's", lambda part: (part.cells.told, "the engine's" if part.cells.told else "the client's")
)


def _rate(claim: PaperThroughput, part: Part) -> Said:
    """Judge one row of table II."""
    import numpy as np

    values = part.cells.values(_METRIC)
    found = change(values, np.full(len(values), claim.tokens_per_s), part.run.bootstrap_seed)
    rate = summarise(values)
    said = f"{part.name}: {mean_sd(rate)} tokens/s (n = {rate.n}); the paper: {claim.tokens_per_s:g}."
    verdict, said = near(found.ratio, said)
    if verdict == CONTRADICTED:
        return UNDECIDED, f"{said} Not reproduced at this quantisation; the paper does not say which it used."
    return verdict, said


THROUGHPUT_CLAIMS: Final[tuple[Claim, ...]] = tuple(
    Claim(
        "V-D, table II",
        f"{board.name}: {board.tokens_per_s:g} tokens/s",
        f"The 95 % interval of our mean N / T_eval lies within {LIKE:.0%} of the paper's (which gives no spread). "
        "Another rate is undecided, not contradicted: the paper does not give its quantisation.",
        "throughput",
        f"s2a-bench throughput --model MINICPM.gguf --mmproj TOWER.gguf --gpu-layers -1 (on a {board.name})",
        _speeds,
        (on_board(board.name), *PAPERS_MODEL, QUANTISATION, _T_EVAL),
        partial(_rate, board),
    )
    for board in paper_throughput()
)
"""Claims about tokens a second."""
