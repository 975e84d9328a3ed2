"""How long it takes until something answers: ``python -m benchmarks.start_up [--times N]``.

Each is a Python process of its own, in turn with one that does nothing; the difference is the cost of the package.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from statistics import median
from time import perf_counter

MAIN = "from s2a_bench.cli import main; main()"
STARTS = {
    "python -c pass": ["pass"],
    "import s2a_bench": ["import s2a_bench"],
    "s2a-bench --help": [MAIN, "--help"],
    "s2a-bench latency --help": [MAIN, "latency", "--help"],
}
TIMES = 10


def measure(times: int = TIMES) -> dict[str, list[float]]:
    """Return the seconds of every start, by its name."""
    taken: dict[str, list[float]] = {name: [] for name in STARTS}
    for _ in range(times):
        for name, arguments in STARTS.items():
            began = perf_counter()
            subprocess.run([sys.executable, "-c", *arguments], stdout=subprocess.DEVNULL, check=True)  # noqa: S603
            taken[name].append(perf_counter() - began)
    return taken


def main() -> None:
    """Print the median and the fastest start of each in ms, and the median without Python's own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=TIMES, help="processes of each")
    taken = measure(parser.parse_args().times)
    bare = median(next(iter(taken.values())))
    print(f"{'ms: median':>12} {'fastest':>8} {'ours':>8}")
    for name, seconds in taken.items():
        print(f"{median(seconds) * 1e3:12.0f} {min(seconds) * 1e3:8.0f} {(median(seconds) - bare) * 1e3:8.0f}  {name}")


if __name__ == "__main__":
    main()
