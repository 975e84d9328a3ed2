"""How often the intervals of ratios hold the truth, and what comparisons see, at known noise: ``make bench-coverage``.

Two cells are simulated whose ratio is known. A launch changes it by a share of its own (``launch sd``; 4 to 13 % were
measured), requests by 15 %, half of which both cells share; the correlation of neighbours is 0.4 by default.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator

import numpy as np
from scipy import stats
from scipy.signal import lfilter

from s2a_bench.stats import Ratio
from s2a_bench.stats.batches import RowCorrelation
from s2a_bench.stats.change import Noise, ratio_of_launches

RATIO = 6.0
REQUESTS_SD = 0.15
LAUNCH_SDS = (0.04, 0.08, 0.13)
REQUESTS = 150
"""Requests a cell, over all launches together."""
TRIALS = 4000
FEWEST = 200
"""Trials of one launch at least, a fifth of the others: its resampling takes time."""


def simulate(rng: np.random.Generator, launches: int, launch_sd: float, correlation: float, n: int) -> list[np.ndarray]:
    """Draw two cells of ``n`` requests, a row a launch."""
    shape = (launches, n // launches)
    load, *own = (_remembering(rng, shape, correlation) for _ in range(3))
    above, below = (np.exp(REQUESTS_SD * (load + each) / math.sqrt(2)) for each in own)
    return [RATIO * np.exp(launch_sd * rng.standard_normal((launches, 1))) * above, below]


def _remembering(rng: np.random.Generator, shape: tuple[int, int], correlation: float) -> np.ndarray:
    """Draw series of standard deviation 1 whose neighbours are correlated (AR(1))."""
    noise = rng.standard_normal((shape[0], shape[1] + 100)) * math.sqrt(1 - correlation**2)
    return np.asarray(lfilter([1], [1, -correlation], noise)[:, 100:])


def interval(cells: list[np.ndarray], seed: int) -> Ratio:
    """Return the ratio as `latency` computes it."""
    above, below = (
        {launch: {block: [float(value)] for block, value in enumerate(row)} for launch, row in enumerate(cell)}
        for cell in cells
    )
    found = ratio_of_launches(above, below, seed)
    assert found is not None  # noqa: S101 - every launch has values
    return found


def coverage(launches: int, launch_sd: float, trials: int, correlation: float = 0.4, n: int = REQUESTS) -> str:
    """Return in how many of the trials the interval holds the truth, with the 95 % interval of that share."""
    rng = np.random.default_rng(13)
    held, widths, warned = 0, [], 0
    for seed in range(trials):
        cells = simulate(rng, launches, launch_sd, correlation, n)
        found = interval(cells, seed)
        low, high = found.low or math.nan, found.high or math.nan
        held += low <= RATIO <= high
        widths.append(math.sqrt(high / low) - 1)
        warned += launches == 1 and any(RowCorrelation.of(cell[0]).dependent for cell in cells)
    low, high = stats.binomtest(held, trials).proportion_ci(method="wilson")
    dependent = f"; a warning in {warned / trials:.0%}" if launches == 1 else ""
    return f"{held / trials:6.1%} [{low:.1%}, {high:.1%}], about +- {np.median(widths):.0%}{dependent}"


def detectable(launches: int, launch_sd: float) -> str:
    """Return the smallest change that a comparison of so many launches a side finds, by their spread."""
    noise = Noise(launch_sd * math.sqrt(2 / launches), 2 * launches - 2)
    return f"{noise.detectable(0.05):5.0%} in 80 of 100 repeats; 10 % in {noise.power(0.1, 0.05):.0%}"


def lines(trials: int) -> Iterator[str]:
    """Yield the study, a line a setting."""
    yield f"95 % intervals of ratios that hold the truth, {trials} trials, {REQUESTS} requests a cell in all"
    for launches in (1, 3, 5):
        for spread in LAUNCH_SDS:
            few = max(FEWEST, trials // 5) if launches == 1 else trials
            yield f"  --launches {launches}, launch sd {spread:4.0%}: {coverage(launches, spread, few)}"
    yield "one launch, no spread from launch to launch, correlated neighbours"
    for n, correlation in ((50, 0.0), (50, 0.4), (50, 0.8), (200, 0.8)):
        yield f"  n = {n:3}, correlation {correlation}: {coverage(1, 0.0, max(FEWEST, trials // 5), correlation, n)}"
    yield "the smallest change that compare finds at p < 0.05, one comparison"
    for launches in (3, 5, 10, 20):
        for spread in LAUNCH_SDS:
            yield f"  {launches:2} launches a side, launch sd {spread:4.0%}: {detectable(launches, spread)}"


def main() -> None:
    """Print the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ratio_coverage", description=__doc__)
    parser.add_argument("--trials", type=int, default=TRIALS, help=f"simulated runs a line (default: {TRIALS})")
    for line in lines(parser.parse_args().trials):
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
