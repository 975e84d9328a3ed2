"""How often the intervals of `capacity` hold the truth, and its searches err, over simulated fleets.

Robots act on chunks of 16 actions at 50 Hz against a server whose service times are known; the truth is what long runs
show. ``make bench-capacity``, some minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from itertools import repeat
from typing import Final

import numpy as np
from scipy import stats

from s2a_bench.plugins.chunks.capacity.config import CapacityPredicted, RobotLoad
from s2a_bench.plugins.chunks.capacity.metrics import RobotTrace, measures
from s2a_bench.plugins.chunks.capacity.search import Judge, Tried, knee, search
from s2a_bench.plugins.chunks.capacity.simulate import UNKNOWN, ServiceTime, simulate

CONFIG: Final = CapacityPredicted(predict="20")
SEARCH: Final = CONFIG.search
"""The defaults of the command: 10 s a look, 4 looks, at most 1 % stalled."""
MEAN_MS: Final = 20.0
SIGMA: Final = float(np.sqrt(np.log1p(0.3**2)))
SERVICES: Final[Mapping[str, Callable[[np.random.Generator, int], np.ndarray]]] = {
    "constant": lambda _, n: np.full(n, MEAN_MS),
    "lognormal, cv 0.3": lambda rng, n: rng.lognormal(np.log(MEAN_MS) - SIGMA**2 / 2, SIGMA, n),
    "two-point: 17 ms, one in ten 50 ms": lambda rng, n: np.where(rng.integers(0, 10, n), 5 / 6, 2.5) * MEAN_MS,
    "exponential": lambda rng, n: rng.exponential(MEAN_MS, n),
    "20 ms, one in a hundred 200 ms": lambda rng, n: np.where(rng.integers(0, 100, n), 1, 10) * MEAN_MS,
}
FLEETS: Final[Mapping[str, Mapping[str, tuple[int, ...]]]] = {
    "queue?trigger=8": dict(
        zip(SERVICES, ((16, 17), (15, 16, 17), (14, 15, 16), (11, 13, 14, 15), (4, 10, 12, 13)), strict=True)
    ),
    "sync": dict(zip(SERVICES, ((16, 17, 18), (4, 14, 16), (4, 12, 16), (4, 10, 14), (4, 10, 14)), strict=True)),
}
"""Mode -> service -> numbers of robots around the knee."""
LONG_S, LONG_RUNS = 1500.0, 12
REQUESTS, RESAMPLES = 50, 39
"""Of one robot, from which a knee is predicted; of these, the range over which holds 95 % of them."""


def traces(service: str, mode: str, robots: int, seconds: float, seed: int) -> list[RobotTrace]:
    """Simulate a fleet; a longer run of a seed goes on where the shorter one ends."""
    return _fleet(mode, robots, seconds, _drawn(service, [seed, robots]), seed)


def _fleet(mode: str, robots: int, seconds: float, times_ns: Iterator[int], seed: int) -> list[RobotTrace]:
    made = CONFIG.but(modes=(mode,)).control.modes[mode]
    span_ns = round(seconds * 1e9) + CONFIG.settle_ns
    times = (ServiceTime(UNKNOWN, each) for each in times_ns)
    return simulate(RobotLoad(CONFIG.setting, made), span_ns, robots, times, np.random.default_rng([seed, 1]))


def _stalled(found: list[RobotTrace]) -> float:
    return float(measures(found, CONFIG.setting, CONFIG.settle_ns).stalled)


def truth(pool: Executor, service: str, mode: str, robots: int) -> float:
    """Return the share of stalled ticks in long runs."""
    return float(np.mean([*pool.map(partial(_long, service, mode, robots), range(LONG_RUNS))]))


def _long(service: str, mode: str, robots: int, run: int) -> float:
    return _stalled(traces(service, mode, robots, LONG_S, 1_000_000 + run))


def interval(service: str, mode: str, robots: int, seconds: float, seed: int) -> tuple[float, float]:
    """Return the 95 % interval of the stalled share of one run."""
    row = measures(traces(service, mode, robots, seconds, seed), CONFIG.setting, CONFIG.settle_ns)
    return row.stalled_low, row.stalled_high


def wrong(service: str, shares: Mapping[int, float], seed: int) -> bool:
    """Return whether a search decides any fleet against the truth; every fleet is looked at as the command does."""
    assert SEARCH.limit is not None  # noqa: S101 - the default limit
    limit, errors = SEARCH.limit, []

    def attempt(robots: int) -> Tried:
        judge = Judge(limit, beyond=False, settle_ns=CONFIG.settle_ns, confidence=SEARCH.confidence)
        for look in range(1, CONFIG.looks + 1):
            found = traces(service, "queue?trigger=8", robots, look * CONFIG.seconds, seed)
            row = measures(found, CONFIG.setting, CONFIG.settle_ns, confidence=SEARCH.confidence)
            verdict, within = judge(row, found)
            if verdict != "undecided":
                errors.append((verdict == "below") != (shares.get(robots, robots > max(shares)) <= limit.share))
                break
        return Tried(robots, verdict, within)

    search(SEARCH.numbers, attempt, {}, bisects=True)
    return any(errors)


def predicted(service: str, seed: int) -> tuple[int, int, int]:
    """Return the knee that 50 requests of one robot predict, and the range of those of `RESAMPLES` resamples."""
    rng = np.random.default_rng([seed, 2])
    recorded = (SERVICES[service](rng, REQUESTS) * 1e6).astype(int)
    found = [
        _knee(partial(_played, recorded if not place else rng.choice(recorded, REQUESTS), place), place)
        for place in range(RESAMPLES + 1)
    ]
    return found[0], min(found[1:]), max(found[1:])


def _played(recorded: np.ndarray, seed: int) -> Iterator[int]:
    rng = np.random.default_rng(seed)
    return (each for _ in repeat(None) for each in rng.permutation(recorded).tolist())


def _drawn(service: str, seed: int | list[int] = 3) -> Iterator[int]:
    rng = np.random.default_rng(seed)
    draws = (SERVICES[service](rng, 4096) * 1e6 for _ in repeat(None))
    return (each for some in draws for each in some.astype(int).tolist())


def _knee(times_ns: Callable[[], Iterator[int]], seed: int, seconds: float = CONFIG.seconds) -> int:
    assert SEARCH.limit is not None  # noqa: S101 - the default limit
    share, tried = SEARCH.limit.share, dict[int, Tried]()

    def attempt(robots: int) -> Tried:
        within = _stalled(_fleet("queue?trigger=8", robots, seconds, times_ns(), seed)) <= share
        return Tried(robots, "below" if within else "above", within)

    search(SEARCH.numbers, attempt, tried, bisects=True)
    found = knee(tried.values())
    return found.robots if found else 0


def _share(hits: int, number: int) -> str:
    low, high = stats.binomtest(hits, number).proportion_ci(method="wilson")
    return f"{hits / number:6.1%} [{low:.1%}, {high:.1%}]"


def lines(trials: int, searches: int, sets: int) -> Iterator[str]:
    """Yield the study, a line a setting."""
    with ProcessPoolExecutor() as pool:
        yield f"95 % intervals of the stalled share that hold the truth, of {trials} runs of 10 s, and of 40 s"
        for mode, service, robots in ((m, s, n) for m, of in FLEETS.items() for s, ns in of.items() for n in ns):
            share = truth(pool, service, mode, robots)
            found = []
            for seconds in (CONFIG.seconds, CONFIG.seconds * CONFIG.looks):
                some = pool.map(partial(interval, service, mode, robots, seconds), range(trials), chunksize=10)
                found.append(_share(sum(low <= share <= high for low, high in some), trials))
            yield f"  {mode}, {service}, {robots} robots, truth {share:7.3%}: {', '.join(found)}"
        yield f"searches of the largest fleet with any wrong decision, of {searches}; 5 % are promised"
        for service in SERVICES:
            shares = {robots: truth(pool, service, "queue?trigger=8", robots) for robots in range(1, 21)}
            errors = sum(pool.map(partial(wrong, service, shares), range(searches), chunksize=5))
            yield f"  {service}: {_share(errors, searches)}"
        yield f"knees predicted from {REQUESTS} requests, {sets} times; ranges of {RESAMPLES} resamples that hold it"
        for service in SERVICES:
            exact = _knee(partial(_drawn, service), 0, LONG_S)
            some = [*pool.map(partial(predicted, service), range(sets))]
            low, high = np.quantile([each for each, _, _ in some], (0.05, 0.95))
            held = sum(first <= exact <= last for _, first, last in some)
            yield f"  {service}: {exact} robots, predicted {low:.0f} to {high:.0f} (90 %), ranges {_share(held, sets)}"


def main() -> None:
    """Print the study."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.capacity_coverage", description=__doc__)
    parser.add_argument("--trials", type=int, default=500, help="simulated runs a fleet (default: 500)")
    parser.add_argument("--searches", type=int, default=200, help="simulated searches a server (default: 200)")
    parser.add_argument("--sets", type=int, default=60, help="sets of requests a server (default: 60)")
    given = parser.parse_args()
    for line in lines(given.trials, given.searches, given.sets):
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
