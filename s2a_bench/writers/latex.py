"""Text tables as LaTeX for papers, with booktabs rules: one `tabular`, or floats of the packages in `PREAMBLE`."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from s2a_bench.text import one_line
from s2a_bench.writers.tables import TextTable

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
\usepackage{array,booktabs,graphicx,longtable}
"""
"""The packages of the tables, and a page wide enough for them."""


def to_latex(table: TextTable) -> str:
    """Return a LaTeX ``tabular`` for booktabs: title and notes are comments, the provenance is a printed last line."""
    lines = [f"% {one_line(note)}" for note in (table.title, *table.footer)]
    lines += [f"\\begin{{tabular}}{{{_columns(table)}}}", r"\toprule", _row(table.header), r"\midrule", *_body(table)]
    origin = f"\\par{{\\footnotesize {escape(table.provenance)}}}"
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", origin]) + "\n"


def to_float(table: TextTable, widths: Sequence[str] = (), *, long: bool = False) -> str:
    r"""Return a LaTeX ``table``, or a ``longtable`` over several pages; title, notes and provenance are the caption.

    ``widths`` are those of columns of running text (``60mm``), if they are the first ones.
    """
    columns, head = _columns(table, widths), [r"\toprule", _row(table.header), r"\midrule"]
    caption = f"\\caption{{{' '.join(escape(text) for text in (table.title + '.', *table.footer))}}}"
    if long:
        lines = [r"{\footnotesize\setlength{\tabcolsep}{3pt}", f"\\begin{{longtable}}{{{columns}}}", caption + r"\\"]
        lines += [*head, r"\endfirsthead", *head, r"\endhead", r"\bottomrule", r"\endlastfoot"]
        lines += [*_body(table), r"\end{longtable}}"]
    else:
        lines = [r"\begin{table}[htbp]", r"\centering\footnotesize\setlength{\tabcolsep}{3pt}", caption]
        lines += [f"\\begin{{tabular}}{{{columns}}}", *head, *_body(table)]
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


def _columns(table: TextTable, widths: Sequence[str] = ()) -> str:
    wide = "".join(f">{{\\raggedright\\arraybackslash}}p{{{width}}}" for width in widths)
    plain = "l" * table.left + "r" * (len(table.header) - table.left)
    return wide + plain[len(widths) :]


def _body(table: TextTable) -> Iterator[str]:
    for place, row in enumerate(table.rows):
        if place and place in table.rules:
            yield r"\midrule"
        yield _row(row)


def _row(texts: Iterable[str]) -> str:
    """Join a row; an entry that opens with a bracket would be an option of the rule before it."""
    entries = map(escape, texts)
    return " & ".join(f"{{{text}}}" if text.startswith("[") else text for text in entries) + r" \\"
