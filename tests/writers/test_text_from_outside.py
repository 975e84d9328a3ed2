"""Text from outside forges no line and moves no cursor, and is no markup."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from s2a_bench.cli.progress import RunProgress
from s2a_bench.provenance import Origins
from s2a_bench.store.schema import PROVENANCE
from s2a_bench.text import one_line, visible
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.latex import to_latex
from s2a_bench.writers.tables import TextTable, lay_out, to_markdown

FORGED = "no\nerror: forged\r\x1b[2J\x1b]0;title\x07\x9b1A\u202eabc\u2028\u200b\ud800"


def as_csv(name: str, value: object) -> str:
    """A table of one value, which tells its provenance itself."""
    return CsvTable.of((name, PROVENANCE), [(value, "measured")]).text(Origins.of_manifest({}))


@given(st.text(st.characters(exclude_categories=())))
def test_a_line_is_a_line_and_all_its_letters_show(text: str) -> None:
    shown = one_line(text)
    assert len(shown.splitlines()) <= 1
    assert not any(letter < " " or "\x7f" <= letter <= "\x9f" for letter in shown)
    shown.encode()
    assert one_line(shown) == shown


def test_plain_text_stays_as_it_is() -> None:
    assert one_line("キッチン é λ → ☃ C:\\x") == "キッチン é λ → ☃ C:\\x"
    assert visible("a\n\tb") == "a\n\tb"


def test_progress_and_tables_show_them(capsys: pytest.CaptureFixture[str]) -> None:
    with RunProgress() as progress:
        progress.say(FORGED)
        progress.stage(f"[red]{FORGED}")
    out = io.StringIO()
    Console(file=out, width=300).print(lay_out(TextTable(FORGED, ("a", FORGED), [(FORGED, "1")], 1), 300))
    for text in (capsys.readouterr().err, out.getvalue()):
        assert "forged" in text
        assert not {"\x1b", "\r", "\x07", "\x9b", "\u202e", "\u2028"} & set(text)
        assert not [line for line in text.splitlines() if line.startswith("error:")]


def test_csv_has_no_control_characters() -> None:
    assert as_csv("a", "\r=1\x1b[2J") == "a,provenance\n\\u000d=1\\u001b[2J,measured\n"


@pytest.mark.parametrize("value", [-1.5, "-1e300", None, "a=b", "=1"])
def test_a_value_stays_one_in_csv(value: object) -> None:
    assert as_csv("a", value) == f"a,provenance\n{'' if value is None else value},measured\n"


def test_markdown_and_latex_find_nothing_in_them() -> None:
    text = "a|b\n| c \\ <b>*x* [y](http://z) \\input{/etc/passwd} $x$"
    table = TextTable(text, ("name",), [(text,)], 1, notes=(text,), provenance="measured")
    title, _, header, rule, row, _, note, _ = to_markdown(table).splitlines()
    assert (header, rule) == ("| name |", "| --- |")
    assert row == r"| a\|b\\n\| c \\ \<b>\*x\* [y]\(http://z) \\input{/etc/passwd} $x$ |"
    assert title == f"**{row[2:-2]}**"
    assert note == row[2:-2]
    lines = to_latex(table).splitlines()
    assert lines[0].startswith("% ")
    assert lines[1].startswith("% ")
    assert r"\textbackslash{}input\{/etc/passwd\} \$x\$" in "".join(lines[2:])
