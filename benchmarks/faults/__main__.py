"""Run the fault matrix and print what came of each fault: the outcome, and the transports that had it."""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict

from benchmarks.faults import FAULTS, WHATS, WHENS, outcomes
from benchmarks.faults import __doc__ as about


def main() -> None:
    """Run the whole matrix, and print it."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="those in whose names this is")
    given = parser.parse_args()
    came = outcomes([fault for fault in FAULTS if given.only in str(fault)])
    rows: dict[tuple[str, str], dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for fault, outcome in came.items():
        broken = "" if outcome in fault.promised else "BROKEN: "
        rows[fault.what, fault.when][broken + outcome].append(fault.transport)
    for what, when in sorted(rows, key=lambda row: (WHATS.index(row[0]), WHENS.index(row[1]))):
        results = [f"{outcome} ({', '.join(transports)})" for outcome, transports in rows[what, when].items()]
        print(f"{what}, {when}: {'; '.join(results)}")
    sys.exit(any(outcome not in fault.promised for fault, outcome in came.items()))


if __name__ == "__main__":
    main()
