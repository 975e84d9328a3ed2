"""How the speed benchmarks time what they run."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter


def turns_s(seconds: float, run: Callable[[], object]) -> list[float]:
    """Repeat for a while and return how long each turn took; the first one warms up and does not count."""
    run()
    turns: list[float] = []
    while not turns or sum(turns) < seconds:
        before = perf_counter()
        run()
        turns.append(perf_counter() - before)
    return turns
