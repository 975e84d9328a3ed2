r"""Text tables as LaTeX for papers: booktabs rules, and numbers set by siunitx.

`to_latex` needs booktabs alone, `to_siunitx` the packages of `PREAMBLE`: a column of plain numbers, with or without a
deviation, becomes an ``S`` column, aligned at the decimal marker; in other columns every number is set in ``\num``.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from typing import Final

from s2a_bench.text import one_line
from s2a_bench.writers.tables import ABSENT, TextTable

_PLAIN: Final = re.compile(r"[-+]?\d+(?:\.\d+)?(?: ± \d+(?:\.\d+)?)?")
_NUMBER: Final = re.compile(r"(?<![\w.])([-+]?\d+(?:\.\d+)?(?: ± \d+(?:\.\d+)?)?)(?![\w.]*\w)")
_SIGNS: Final = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "_": r"\_",
    "%": r"\%",
    "&": r"\&",
    "#": r"\#",
    "$": r"\$",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "±": r"$\pm$",
    "²": r"$^2$",
    "³": r"$^3$",
    "·": r"$\cdot$",
    "→": r"$\to$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "λ": r"$\lambda$",
    "\N{GREEK SMALL LETTER RHO}": r"$\rho$",
    "Δ": r"$\Delta$",
    "\N{EN DASH}": "--",
    "\N{EM DASH}": "---",
    "\N{MINUS SIGN}": "$-$",
}

PREAMBLE: Final = r"""\documentclass[a4paper,landscape]{article}
\usepackage[margin=15mm]{geometry}
\usepackage[utf8]{inputenc}
\usepackage{array,booktabs,graphicx,longtable,siunitx}
\sisetup{separate-uncertainty=true,retain-explicit-plus=true}
"""
"""The packages of the tables, and a page wide enough for them."""


def to_latex(table: TextTable) -> str:
    """Return a LaTeX ``tabular`` for booktabs: title and notes are comments, the provenance is a printed last line."""
    lines = [f"% {one_line(note)}" for note in (table.title, *table.footer)]
    lines += [f"\\begin{{tabular}}{{{'l' * table.left}{'r' * (len(table.header) - table.left)}}}", "\\toprule"]
    lines += [_row(map(escape, table.header)), "\\midrule"]
    for place, row in enumerate(table.rows):
        lines += [*(["\\midrule"] if place in table.rules else []), _row(map(escape, row))]
    origin = f"\\par{{\\footnotesize {escape(table.provenance)}}}"
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", origin]) + "\n"


def to_siunitx(table: TextTable, widths: Sequence[str] = (), *, long: bool = False) -> str:
    r"""Return a LaTeX ``table``, or a ``longtable`` over several pages; title, notes and provenance are the caption.

    ``widths`` are those of columns of running text (``60mm``, empty for an ordinary one).
    """
    columns = list(zip(*table.rows, strict=True)) if table.rows else [()] * len(table.header)
    kinds = [
        _kind(column, names=place < table.left, width=widths[place] if place < len(widths) else "")
        for place, column in enumerate(columns)
    ]
    names = (escape(name) for name in table.header)
    head = _row([name if place < table.left else f"{{{name}}}" for place, name in enumerate(names)])
    caption = f"\\caption{{{' '.join(escape(text) for text in (table.title + '.', *table.footer))}}}"
    body = []
    for place, row in enumerate(table.rows):
        body += [r"\midrule"] if place in table.rules and place else []
        entries = zip(row, kinds, strict=True)
        body.append(_row([_entry(text, kind, names=n < table.left) for n, (text, kind) in enumerate(entries)]))
    if long:
        lines = [
            r"{\footnotesize\setlength{\tabcolsep}{3pt}",
            f"\\begin{{longtable}}{{{''.join(kinds)}}}",
            caption + r"\\",
        ]
        lines += [r"\toprule", head, r"\midrule", r"\endfirsthead", r"\toprule", head, r"\midrule", r"\endhead"]
        lines += [r"\bottomrule", r"\endlastfoot", *body, r"\end{longtable}}"]
    else:
        lines = [r"\begin{table}[htbp]", r"\centering\footnotesize\setlength{\tabcolsep}{3pt}", caption]
        lines += [f"\\begin{{tabular}}{{{''.join(kinds)}}}", r"\toprule", head, r"\midrule", *body]
        lines += [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
    return "\n".join(lines) + "\n"


def document(title: str, sections: Sequence[str]) -> str:
    """Return a document that compiles, with sections, each on a new page."""
    body = "\n\\clearpage\n".join(sections)
    head = f"{PREAMBLE}\\title{{{escape(title)}}}\n\\date{{}}\n"
    return f"{head}\\begin{{document}}\n\\maketitle\n{body}\n\\end{{document}}\n"


def escape(text: str) -> str:
    """Escape a text for LaTeX; an unsupported character becomes its base letter, or its code."""
    return "".join(_SIGNS.get(char) or _sign(char) for char in text)


def _sign(char: str) -> str:
    """Return a character that Latin fonts have, or a replacement."""
    if char in "\n\r\t":
        return " "
    if (
        " " <= char <= "~"
        or "\N{LATIN CAPITAL LETTER A WITH GRAVE}" <= char <= "\N{LATIN SMALL LETTER Y WITH DIAERESIS}"
    ):
        return char
    plain = unicodedata.normalize("NFKD", char).encode("ascii", "ignore").decode()
    return plain if plain.isalnum() else f"[U+{ord(char):04X}]"


def _kind(column: Sequence[str], *, names: bool, width: str) -> str:
    if width:
        return f">{{\\raggedright\\arraybackslash}}p{{{width}}}"
    if names:
        return "l"
    texts = [text for text in column if text not in {"", ABSENT}]
    if not texts or not all(_PLAIN.fullmatch(text) for text in texts):
        return "r"
    before, after, spread = 1, 0, 0
    for text in texts:
        value, _, sd = text.lstrip("+-").partition(" ± ")
        whole, _, decimals = value.partition(".")
        before, after = max(before, len(whole)), max(after, len(decimals))
        spread = max(spread, len(sd.replace(".", "").lstrip("0") or "0") if sd else 0)
    sign = "-" if any(text.startswith("-") for text in texts) else ""
    return f"S[table-format={sign}{before}.{after}{f'({spread})' if spread else ''}]"


def _entry(text: str, kind: str, *, names: bool) -> str:
    if kind.startswith("S"):
        return "{--}" if text == ABSENT else _plain(text)
    if names or kind != "r":
        return escape(text)
    parts = enumerate(_NUMBER.split(text))  # every second one is a number, left to siunitx
    return "".join(f"\\num{{{_plain(part)}}}" if place % 2 else escape(part) for place, part in parts)


def _plain(number: str) -> str:
    return number.replace("±", r"\pm")


def _row(entries: Iterable[str]) -> str:
    """Join a row; an entry that opens with a bracket would be an option of the rule before it."""
    return " & ".join(f"{{{text}}}" if text.startswith("[") else text for text in entries) + r" \\"
