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

from s2a_bench.report.compare.comparison import LEVEL
from s2a_bench.stats import Ratio
from s2a_bench.stats.batches import Blocks, RowCorrelation
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
    above, below = ({launch: Blocks(row, np.arange(len(row))) for launch, row in enumerate(cell)} for cell in cells)
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
    return f"{noise.detectable(0.05):5.0%} in 80 of 100 repeats; 10 % in {power(noise, 0.1):.0%}"


def power(noise: Noise, change: float) -> float:
    """Return the share of repeats in which a change of this size is found at a level of 5 %."""
    shift = math.log1p(change) if noise.logarithmic else change
    critical = float(stats.t.isf(0.025, noise.freedom))
    return float(stats.nct.sf(critical, noise.freedom, abs(shift) / noise.error))


TURNS = ("AB", "ABBA", "AABB", "random", "blocks")
DRIFTS = ("trend", "walk", "swing", "halves")


def false_alarms(launches: int, turns: str, drift: str, trials: int) -> float:
    """Return how often Welch's test, as `compare` has it, calls so many launches a side of one thing different.

    Half of a launch's variance is its own, half is the machine's at its time: a trend, a random walk, a swing of one
    period, or a level for each half of the time.
    """
    rng, n = np.random.default_rng(17), 2 * launches
    at = np.linspace(-1, 1, n)
    slow = {
        "trend": np.broadcast_to(at, (trials, n)),
        "walk": np.cumsum(rng.standard_normal((trials, n)), axis=1),
        "swing": np.sin(np.pi * at + rng.uniform(0, 2 * np.pi, (trials, 1))),
        "halves": np.repeat(rng.standard_normal((trials, 2)), launches, axis=1),
    }[drift]
    slow = slow - slow.mean(axis=1, keepdims=True)
    values = slow / math.sqrt((slow**2).mean()) + rng.standard_normal((trials, n))
    order = "A" * launches + "B" * launches if turns in {"random", "blocks"} else (turns * n)[:n]
    if order.count("A") > launches:
        order = order[:-1] + "B"
    is_b = np.broadcast_to(np.array(list(order)) == "B", (trials, n))
    if turns == "random":
        is_b = rng.permuted(is_b, axis=1)
    below, above = (values[chosen].reshape(trials, launches) for chosen in (~is_b, is_b))
    return float((stats.ttest_ind(below, above, axis=1, equal_var=False).pvalue < LEVEL).mean())


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
    yield f"the same thing called different, half of the variance between launches a drift ({', '.join(DRIFTS)})"
    for launches in (3, 5, 10, 20):
        for turns in TURNS:
            found = [false_alarms(launches, turns, drift, 2 * trials) for drift in DRIFTS]
            yield f"  {launches:2} launches a side, {turns}: {', '.join(f'{each:.1%}' for each in found)}"


def main() -> None:
    """Print the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ratio_coverage", description=__doc__)
    parser.add_argument("--trials", type=int, default=TRIALS, help=f"simulated runs a line (default: {TRIALS})")
    for line in lines(parser.parse_args().trials):
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
