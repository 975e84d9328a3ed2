"""How many control ticks a second the modes of acting on chunks simulate on one core: ``make bench-chunks``.

*Every tick* means: from latencies of shape (R,), known, to the chunk, index, age and stall of each tick. *Cycles only*
is what became of each request, which is enough for stalls, jumps and triggers.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from statistics import median

import numpy as np

from benchmarks.timing import turns_s
from s2a_bench.boards.gaps import Lognormal
from s2a_bench.plugins.chunks.modes import ControlSetting, Mode, mode
from s2a_bench.plugins.chunks.modes.cycles import step

MODES = (
    "sync",
    "queue?trigger=6",
    "queue?trigger=12&execute=8",
    "streamed?gap_s=0.03&trigger=6",
    "replace?execute=8",
    "replace?execute=2&under_way=many",
    "aggregate?trigger=6",
    "aggregate?trigger=12",
)
SETTING = ControlSetting(period_ns=20_000_000, horizon=16)
LATENCY = Lognormal(0.08, 0.3)
REQUESTS = 20_000
STEPPED = 500
SECONDS = 1.0


@dataclass(frozen=True, slots=True)
class Speed:
    """What was timed, and how many ticks a second came of it: in the median turn."""

    what: str
    cycles_per_s: float
    ticks_per_s: float
    stepped_per_s: float


def measure(seconds: float = SECONDS) -> list[Speed]:
    """Time each mode, on this thread alone."""
    drawn = LATENCY.sample(np.random.default_rng(0), REQUESTS, 1)[:, 0]
    latency_ns = np.rint(drawn * 1e9).astype(np.int64)
    return [_speed(written, mode(written), latency_ns, seconds) for written in MODES]


def _speed(written: str, made: Mode, latency_ns: np.ndarray, seconds: float) -> Speed:
    few = latency_ns[:STEPPED]
    ticks, stepped = made.cycles(latency_ns, SETTING).ticks, made.cycles(few, SETTING).ticks
    return Speed(
        written,
        ticks / median(turns_s(seconds, lambda: made.cycles(latency_ns, SETTING))),
        ticks / median(turns_s(seconds, lambda: made.ticks(latency_ns, SETTING))),
        stepped / median(turns_s(seconds, lambda: step(made, few, SETTING))),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.chunk_speed", description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="how long to measure each number (default: 1)")
    found = measure(parser.parse_args().seconds)
    sys.stdout.write(
        f"million control ticks/s, H = {SETTING.horizon}, 50 Hz, L = 80 ms (lognormal, CV .3), one core: "
        "cycles only, every tick, stepper\n"
    )
    for speed in found:
        numbers = (speed.cycles_per_s, speed.ticks_per_s, speed.stepped_per_s)
        sys.stdout.write("".join(f"{each / 1e6:9.2f}" for each in numbers) + f"  {speed.what}\n")


if __name__ == "__main__":
    main()
