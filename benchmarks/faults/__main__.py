"""Run the fault matrix, print it, and write it into docs/reliability.md with --docs."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from benchmarks.faults import FAULTS, TRANSPORTS, WHATS, WHENS, Fault, outcomes
from benchmarks.faults import __doc__ as about

DOCS = Path(__file__).parents[2] / "docs" / "reliability.md"
TABLE = re.compile(r"(<!-- faults -->\n).*?(<!-- /faults -->)", re.DOTALL)


def table(came: dict[Fault, str]) -> str:
    """Return the matrix in Markdown, times of a like outcome in one row; a broken promise stands out."""
    lines = [f"| {' | '.join(('what', 'when', *TRANSPORTS))} |", "|---" * (2 + len(TRANSPORTS)) + "|"]
    for what in WHATS:
        rows: dict[tuple[str, ...], list[str]] = {}
        for when in WHENS:
            faults = [Fault(what, when, transport) for transport in TRANSPORTS]
            cells = tuple(_cell(fault, came.get(fault, "-")) for fault in faults)
            rows.setdefault(cells, []).append(when)
        lines += [f"| {' | '.join((what, ', '.join(whens), *cells))} |" for cells, whens in rows.items()]
    return "\n".join(lines)


def _cell(fault: Fault, got: str) -> str:
    return got if got in {*fault.promised, "-"} else f"**{got[:80]}**"


def main() -> None:
    """Run the whole matrix, and print it."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", action="store_true", help="write the table into docs/reliability.md")
    parser.add_argument("--only", default="", help="those in whose names this is")
    given = parser.parse_args()
    came = outcomes([fault for fault in FAULTS if given.only in str(fault)])
    text = table(came)
    if given.docs:
        page = DOCS.read_text(encoding="utf-8")
        DOCS.write_text(TABLE.sub(lambda found: f"{found[1]}{text}\n{found[2]}", page), encoding="utf-8")
    print(text)
    sys.exit(any(outcome not in fault.promised for fault, outcome in came.items()))


if __name__ == "__main__":
    main()
