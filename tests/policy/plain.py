"""The closed forms again, one plan at a time in plain Python: slow and obvious, to check the fast ones against.

Each function takes lists of one plan, in seconds, and follows the words of the definition (shared POLICY page, sections
1 to 3) rather than the formulas of the package.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

Seconds = Sequence[float]


def safe_start(arrival: Seconds, durations: Seconds) -> float:
    """Say when to start so that every skill is there when the ones before it have run."""
    return max(t - sum(durations[:i]) for i, t in enumerate(arrival))


def execute(arrival: Seconds, durations: Seconds, first: float) -> list[float]:
    """Start each skill when it is there and the one before has ended."""
    starts: list[float] = []
    free = first
    for t, duration in zip(arrival, durations, strict=True):
        starts.append(max(free, t))
        free = starts[-1] + duration
    return starts


def stalls(starts: Seconds, durations: Seconds) -> list[float]:
    """Say for how long nothing runs between one skill and the next."""
    ends = [s + d for s, d in zip(starts, durations, strict=True)]
    return [max(0.0, following - end) for following, end in zip(starts[1:], ends[:-1], strict=True)]


def held(arrival: Seconds, starts: Seconds, durations: Seconds, latest: Seconds) -> list[float]:
    """Hold each skill on at its end until the next has arrived, within its bound."""
    runs: list[float] = []
    for i, duration in enumerate(durations):
        end = starts[i] + duration
        if i + 1 < len(durations) and arrival[i + 1] > end:
            end = min(arrival[i + 1], starts[i] + latest[i])
        runs.append(end - starts[i])
    return runs


def fluidity(stall: Seconds, nominal: Seconds, tolerance: float) -> float:
    """Count deadlines met and missed as Etalon's algorithm does, token for skill (arXiv 2407.07000)."""
    met, missed = 1, 0
    for late, budget in zip(stall, nominal[:-1], strict=True):
        if late <= tolerance:
            met += 1
        else:
            missed += int(late // budget) + 1
    return met / (met + missed)


def learned(mean: float, plan: float, token: float, gaps: Seconds) -> tuple[float, float]:
    """Weigh the mean that was believed and each gap by their precision; both variances are relative to the mean."""
    precision = 1 / plan + len(gaps) / token
    return (mean / plan + sum(gaps) / token) / precision, 1 / precision


def watched(mean: float, plan_cv: float, token_cv: float, tokens: Seconds) -> list[tuple[float, float, bool]]:
    """Say after each token what is learned of the gaps, and whether the plan has slowed down (docs/shift.md)."""
    learned_rows: list[tuple[float, float, bool]] = []
    slow, first, believed = False, 0, (mean, plan_cv**2)
    for now in range(len(tokens)):
        gaps = [later - earlier for earlier, later in pairwise(tokens[first : now + 1])]
        surprises = [(0.0, 0, mean)]
        for last in range(1, min(8, len(gaps)) + 1):
            expected, variance = learned(*believed, token_cv**2, gaps[:-last])
            deviation = expected * math.sqrt(last * token_cv**2 + last**2 * variance)
            surprises.append(((sum(gaps[-last:]) - last * expected) / deviation, last, expected))
        most, last, expected = max(surprises)
        if most > 4:
            slow, first, believed = True, now - last, (expected, 1.0)
        elif slow and min(surprises)[0] < -4:
            slow, first, believed = False, 0, (mean, plan_cv**2)
        gaps = [later - earlier for earlier, later in pairwise(tokens[first : now + 1])]
        learned_rows.append((*learned(*believed, token_cv**2, gaps), slow))
    return learned_rows
