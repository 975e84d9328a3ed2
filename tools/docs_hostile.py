"""Write what hostile peers cost into docs/reliability.md: `.venv/bin/python tools/docs_hostile.py hostile.xml`.

The file is what `make hostile` wrote: each case has recorded the time and the most memory of the end that it attacked.
The table stands between `<!-- hostile -->` and `<!-- /hostile -->`.
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree as ET

DOCS = Path(__file__).parent.parent / "docs" / "reliability.md"
TABLE = re.compile(r"(<!-- hostile -->\n).*?(<!-- /hostile -->)", re.DOTALL)
COST = re.compile(r"(.*): (?:\d+ answered, )?([\d.]+) s, (\d+) MiB")


def table(xml: str) -> str:
    """Return the table: for each end the number of its cases, and the dearest in memory and in time."""
    costs: dict[str, list[tuple[int, float, str]]] = defaultdict(list)
    for test in ET.fromstring(xml).iter("testcase"):  # noqa: S314 - pytest's own
        case = re.sub(r".*\[(.*)\]", r"\1", test.attrib["name"])
        for each in test.iter("property"):
            if each.attrib["name"] == "cost" and (found := COST.fullmatch(each.attrib["value"])):
                costs[found[1]].append((int(found[3]), float(found[2]), case))
    lines = ["| end | cases | most memory, MiB | longest, s |", "|---|---|---|---|"]
    for end, cases in costs.items():
        memory, _, dearest = max(cases)
        seconds, longest = max((seconds, case) for _, seconds, case in cases)
        lines.append(f"| {end} | {len(cases)} | {memory} ({dearest}) | {seconds:.1f} ({longest}) |")
    return "\n".join(lines)


def main() -> None:
    """Write the page anew."""
    new = table(Path(sys.argv[1]).read_text(encoding="utf-8"))
    page = DOCS.read_text(encoding="utf-8")
    DOCS.write_text(TABLE.sub(lambda found: f"{found[1]}{new}\n{found[2]}", page), encoding="utf-8")
    print(new)


if __name__ == "__main__":
    main()
