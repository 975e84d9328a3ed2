"""What the paper's figure 2 is judged by: trials of naive execution on both sides of its line."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.boundary.rows import BOUNDARY
from s2a_bench.report.claims.claim import CONTRADICTED, SUPPORTED, UNDECIDED, Claim, Need, Part, Said

if TYPE_CHECKING:
    from collections.abc import Iterator

    from s2a_bench.store.run import Run


def _plane(run: Run) -> Iterator[Part]:
    if not run.table(BOUNDARY).empty:
        yield Part(run, "plane", None, run.origins.every)


def _is_even(part: Part) -> tuple[bool, str]:
    from s2a_bench.experiments.boundary.view.tables import is_random

    return (False, "with jitter") if is_random(part.run) else (True, "evenly")


def _ends_early(part: Part) -> tuple[bool, str]:
    factor = float(part.run.manifest.get("configuration", {}).get("t_min", 1.0))
    return factor < 1, f"T_min = {factor:g} T_nom"


_EVENLY: Final = Need("tokens", "evenly: with jitter no line separates the regions", _is_even)
_SHORTER: Final = Need("settings", "T_min < T_nom, else both have the same line", _ends_early)


def _region(part: Part, *, above: bool) -> Said:
    """Try the points on one side of R = L / T_min, skills running for T_nom, as naive runs them."""
    from s2a_bench.experiments.boundary.view.tables import grid_of

    least_s = float(grid_of(part.run, "t_min")["duration_s"].iloc[0])
    points = grid_of(part.run, "t_nom")
    on_side = points["tokens_per_s"] >= points["tokens_per_skill"] / least_s
    points = points[on_side if above else ~on_side]
    stalls, side = int((points["p_stall"] > 0).sum()), "above" if above else "below"
    said = f"Naive stalls at {stalls} of {len(points)} points {side} R = L/T_min ({least_s:g} s)."
    if points.empty:
        return UNDECIDED, said
    if above:
        return CONTRADICTED if stalls else SUPPORTED, said
    if stalls == len(points):
        return SUPPORTED, said
    nominal_s = float(points["duration_s"].iloc[0])
    return (
        CONTRADICTED,
        f"{said} The others are stall-free since skills run for T_nom ({nominal_s:g} s): the line is R = L/T_nom.",
    )


BOUNDARY_CLAIMS: Final[tuple[Claim, ...]] = (
    Claim(
        "IV-F, figure 2",
        "Where R >= L/T_min naive execution suffices",
        "Naive, which runs skills for T_nom, is tried at every point above the line: one stall contradicts.",
        "boundary",
        "s2a-bench boundary",
        _plane,
        (_EVENLY,),
        partial(_region, above=True),
    ),
    Claim(
        "IV-F, figure 2",
        "Below R = L/T_min stalls occur",
        "The same below the line: one point without a stall contradicts.",
        "boundary",
        "s2a-bench boundary",
        _plane,
        (_EVENLY, _SHORTER),
        partial(_region, above=False),
    ),
)
"""Claims about the boundary."""
