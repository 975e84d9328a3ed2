"""How many timelines a second the policies evaluate on one core: ``make bench-policy``.

*Evaluate* means: from arrivals and durations of shape (N, M), known and in the processor's cache, to S0, the starts and
ends of naive, wait-then-act and clairvoyant stream-to-act, and naive's stalls (count, total, longest). One plan is one
timeline, though three policies come of it. *With random tokens* every token's gap is drawn as well, and the tokens are
added up to arrivals.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np

from benchmarks.evaluate import evaluate
from benchmarks.timing import turns_s
from s2a_bench.boards.gaps import Lognormal
from s2a_bench.policy import TOLERANCE_S, Plans, policy
from s2a_bench.policy.arrivals import fragments, tokens
from s2a_bench.policy.schedule import BLOCK, elastic

N_SKILLS = 32
SECONDS = 2.0
"""How long each line is measured for."""
DRAWN = 1024
"""Plans per draw of random tokens: at most 192 tokens a plan, 1.5 MiB, stay in the cache and cost no new memory."""
GAPS = Lognormal(1 / 4.8, 0.2)
"""The paper's Orin AGX with the study's token jitter."""


@dataclass(frozen=True, slots=True)
class Speed:
    """What was timed, and how many timelines a second came of it: in the median turn, and in the fastest."""

    what: str
    median_per_s: float
    best_per_s: float


def measure(seconds: float = SECONDS) -> list[Speed]:
    """Time every way to evaluate plans of 32 skills, on this thread alone."""
    rng = np.random.default_rng(0)
    arrival_s = fragments(tokens(GAPS, 0.5, 4 * N_SKILLS, BLOCK, rng), 4).copy()
    nominal_s = rng.uniform(0.65, 1.35, arrival_s.shape)
    plans = Plans(arrival_s, nominal_s, 0.8 * nominal_s, 1.5 * nominal_s)
    few = [(arrival_s[:, i].tolist(), nominal_s[:, i].tolist()) for i in range(1000)]
    naive = policy("naive")
    found = [
        _time("evaluate", BLOCK, seconds, lambda: evaluate(arrival_s, nominal_s)),
        _time("schedule of naive: every start and duration", BLOCK, seconds, lambda: naive.schedule(plans)),
        _time("schedule of the elastic optimum: every start and duration", BLOCK, seconds, lambda: elastic(plans)),
    ]
    for length in (1, 2, 4, 6):

        def drawn(length: int = length) -> None:
            token_s = tokens(GAPS, 0.5, length * N_SKILLS, DRAWN, rng)
            evaluate(fragments(token_s, length), nominal_s[:, :DRAWN])

        found.append(_time(f"evaluate with random tokens, {length} a skill", DRAWN, seconds, drawn))
    found.append(_time("evaluate in a plain Python loop", len(few), seconds, lambda: [_plain(*plan) for plan in few]))
    return found


def _time(what: str, plans: int, seconds: float, run: Callable[[], object]) -> Speed:
    turns = turns_s(seconds, run)
    return Speed(what, plans / median(turns), plans / min(turns))


def _plain(arrival_s: list[float], duration_s: list[float]) -> tuple[float, float, float, int, float, float]:
    """Evaluate one plan as `evaluate` does, skill by skill."""
    safe_s, work_s, longest_s, stalls = arrival_s[0], 0.0, 0.0, 0
    for t, d in zip(arrival_s[1:], duration_s, strict=False):
        work_s += d
        stall_s = t - work_s - safe_s
        if stall_s > 0:
            safe_s += stall_s
            longest_s = max(longest_s, stall_s)
            stalls += stall_s > TOLERANCE_S
    work_s += duration_s[-1]
    return safe_s, safe_s + work_s, arrival_s[-1] + work_s, stalls, safe_s - arrival_s[0], longest_s


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.policy_speed", description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="how long to measure each line (default: 2)")
    seconds = parser.parse_args().seconds
    sys.stdout.write(
        f"million timelines/s, N = {N_SKILLS}, float64, one core, {BLOCK} plans a pass: median turn (best)\n"
    )
    for speed in measure(seconds):
        sys.stdout.write(f"{speed.median_per_s / 1e6:8.2f} ({speed.best_per_s / 1e6:6.2f})  {speed.what}\n")


if __name__ == "__main__":
    main()
