"""Name the tests that failed and passed when run again: `python tools/flaky.py FIRST.xml AGAIN.xml LOGS`.

The files are JUnit reports of the two runs, of pytest's family `xunit1`, which has each test's file. For each such test
one line is printed, `DEFECT: ...`, and the log of its failure is kept in the folder LOGS. A test that fails twice is no
such defect: it fails CI by itself.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from xml.etree import ElementTree as ET


def tests(report: Path) -> dict[str, ET.Element]:
    """Return the tests of a report by their name on pytest's command line; none of a report that is not there."""
    if not report.exists():
        return {}
    return {name_of(case): case for case in ET.parse(report).iter("testcase")}  # noqa: S314 - pytest's own


def name_of(case: ET.Element) -> str:
    """Return FILE::CLASS::TEST."""
    file, path = case.get("file", ""), case.get("classname", "").split(".")
    classes = path[len(Path(file).with_suffix("").parts) :]
    return "::".join([file, *classes, case.get("name", "")])


def failure_of(case: ET.Element) -> ET.Element | None:
    """Return how a test failed, None if it did not."""
    failure = case.find("failure")
    return failure if failure is not None else case.find("error")


def defects(first: Path, again: Path, logs: Path) -> list[str]:
    """Return a line for each test that failed and then passed; write their logs."""
    lines = []
    repeated = tests(again)
    for name, case in tests(first).items():
        failure = failure_of(case)
        if failure is None or name not in repeated or len(repeated[name].findall("*")) != _outputs(repeated[name]):
            continue
        logs.mkdir(parents=True, exist_ok=True)
        log = logs / (re.sub(r"[^\w.-]+", "_", name)[:200] + ".log")
        log.write_text("\n".join(part for part in case.itertext() if part.strip()), encoding="utf-8")
        message = (failure.get("message") or "no message").splitlines()[0]
        lines.append(f"DEFECT: {name} failed, then passed when run again: {message} (log: {log})")
    return lines


def _outputs(case: ET.Element) -> int:
    """Return how many elements of a test say nothing about its result."""
    return sum(len(case.findall(kind)) for kind in ("system-out", "system-err", "properties"))


if __name__ == "__main__":
    for line in defects(*map(Path, sys.argv[1:])):
        print(line)
