"""The table of what hostile peers cost."""

from __future__ import annotations

import runpy
from pathlib import Path

XML = """<testsuites><testsuite>
<testcase name="test_a[one]">
<properties><property name="cost" value="http, server: 1.50 s, 90 MiB"/></properties>
</testcase>
<testcase name="test_a[two]">
<properties><property name="cost" value="http, server: 0.25 s, 700 MiB"/></properties>
</testcase>
<testcase name="test_b"/>
</testsuite></testsuites>"""


def test_each_end_has_its_dearest_cases() -> None:
    tool = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "docs_hostile.py"))
    assert tool["table"](XML).splitlines()[2:] == ["| http, server | 2 | 700 (two) | 1.5 (one) |"]


def test_the_page_has_places_for_both_tables() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reliability.md").read_text(encoding="utf-8")
    for name in ("hostile", "faults"):
        assert page.count(f"<!-- {name} -->") == page.count(f"<!-- /{name} -->") == 1
