"""Monte Carlo timelines on several processes, with and without Ray: ``make bench-ray``.

The plans are drawn in blocks, each from its own seed, so that the numbers do not depend on which worker computes one:
the check sums of all lines must be equal. A timeline is one plan under naive, wait-then-act and clairvoyant
stream-to-act; every token's gap is drawn.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from importlib.util import find_spec
from multiprocessing import get_context
from typing import Final

import numpy as np

from benchmarks.evaluate import evaluate
from s2a_bench.boards.gaps import Lognormal
from s2a_bench.clock import now_ns
from s2a_bench.policy.arrivals import fragments, tokens

BLOCK: Final = 1 << 14
"""Plans drawn from one seed."""
N_SKILLS: Final = 8
TOKENS_PER_SKILL: Final = 6
PROMPT_S: Final = 0.5
T_NOM_S: Final = 1.0
GAPS: Final = Lognormal(1 / 4.8, 0.2)
"""The paper's Orin AGX with the study's token jitter."""


@dataclass(frozen=True, slots=True)
class Part:
    """The result of a block: sums over its plans, and the digest of every number."""

    plans: int
    stalled: int
    stall_s: float
    digest: bytes


@dataclass(frozen=True, slots=True)
class Line:
    """One way to compute all blocks."""

    how: str
    workers: int
    seconds: float
    p_any_stall: float
    mean_stall_s: float
    checksum: str


def part(seed: np.random.SeedSequence, plans: int) -> Part:
    """Draw and evaluate one block."""
    rng = np.random.default_rng(seed)
    arrival_s = fragments(tokens(GAPS, PROMPT_S, N_SKILLS * TOKENS_PER_SKILL, plans, rng), TOKENS_PER_SKILL)
    found = evaluate(arrival_s, rng.uniform(0.65, 1.35, arrival_s.shape) * T_NOM_S)
    digest = sha256()
    for name in ("naive_start_s", "safe_start_s", "wait_start_s", "end_s", "wait_end_s", "naive_stalls"):
        digest.update(getattr(found, name).tobytes())
    stalled = int(np.count_nonzero(found.naive_stalls))
    return Part(plans, stalled, float(found.naive_stall_s.sum()), digest.digest())


def work(timelines: int, seed: int) -> list[tuple[np.random.SeedSequence, int]]:
    """Split timelines into blocks, each with its seed."""
    sizes = [min(BLOCK, timelines - done) for done in range(0, timelines, BLOCK)]
    return list(zip(np.random.SeedSequence(seed).spawn(len(sizes)), sizes, strict=True))


def measure(timelines: int, seed: int, workers: Sequence[int], *, ray: bool) -> Iterator[Line]:
    """Compute the same timelines in this process, in pools of processes and, with --ray, on Ray; without start-up."""
    blocks = work(timelines, seed)
    part(*blocks[0])
    before_ns = now_ns()
    yield _line("this process", 1, [part(*block) for block in blocks], before_ns)
    for count in workers:
        with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
            list(pool.map(part, *zip(*blocks[:1] * count * 2, strict=True)))
            before_ns = now_ns()
            yield _line("processes", count, list(pool.map(part, *zip(*blocks, strict=True))), before_ns)
    for count in workers if ray else ():
        yield _on_ray(blocks, count)


def _on_ray(blocks: list[tuple[np.random.SeedSequence, int]], count: int) -> Line:
    """Compute the blocks on a local cluster of ``count`` cores."""
    from s2a_bench.machine.cluster import LOCAL, connect

    connect(LOCAL, count)
    import ray

    try:
        remote = ray.remote(part)
        ray.get([remote.remote(*blocks[0]) for _ in range(count * 2)])
        before_ns = now_ns()
        return _line("Ray, local", count, ray.get([remote.remote(*block) for block in blocks]), before_ns)
    finally:
        ray.shutdown()


def _line(how: str, workers: int, parts: Sequence[Part], before_ns: int) -> Line:
    """Add up the blocks in their order."""
    seconds = (now_ns() - before_ns) / 1e9
    plans = sum(each.plans for each in parts)
    checksum = sha256(b"".join(each.digest for each in parts)).hexdigest()[:16]
    stalled, stall_s = sum(each.stalled for each in parts), sum(each.stall_s for each in parts)
    return Line(how, workers, seconds, stalled / plans, stall_s / plans, checksum)


def main() -> int:
    """Print the table; 1 where the numbers differ."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sweep_scaling", description=__doc__)
    parser.add_argument("--timelines", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, nargs="+", help="default: 1, 2, 4 ... to the number of cores")
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    workers = arguments.workers or [1 << power for power in range(cores.bit_length())]
    ray = find_spec("ray") is not None
    say = sys.stdout.write
    say(f"{arguments.timelines} timelines, N = {N_SKILLS}, L = {TOKENS_PER_SKILL}, drawn tokens, {cores} cores\n")
    say(f"{'how':14}{'workers':>8}{'s':>9}{'million/s':>11}{'speed-up':>10}  P(naive stalls)  mean stall  check sum\n")
    lines: list[Line] = []
    for line in measure(arguments.timelines, arguments.seed, workers, ray=ray):
        lines.append(line)
        say(
            f"{line.how:14}{line.workers:8}{line.seconds:9.2f}{arguments.timelines / line.seconds / 1e6:11.2f}"
            f"{lines[0].seconds / line.seconds:10.2f}  {line.p_any_stall:15.6f}  {line.mean_stall_s:8.6f} s  "
            f"{line.checksum}\n"
        )
    if not ray:
        say("Ray is not installed: .venv/bin/pip install -e '.[ray]' -c constraints.txt\n")
    same = len({line.checksum for line in lines}) == 1
    say("the numbers are the same everywhere\n" if same else "the numbers DIFFER\n")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
