"""The files of a comparison in a folder of the user's: table, figure and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2a_bench.errors import StoreError
from s2a_bench.report.compare.figure import build_forest
from s2a_bench.report.compare.tables import compare_csv, compare_table
from s2a_bench.writers.figures import marked
from s2a_bench.writers.style import paper_column
from s2a_bench.writers.tables import to_latex, to_markdown

if TYPE_CHECKING:
    from s2a_bench.report.compare.comparison import ComparedRuns


def write_comparison(folder: Path, compared: ComparedRuns, whole: Mapping[str, Any]) -> list[Path]:
    """Write compare.md, .tex, .csv, .json, .png and .pdf; no figure where nothing has a size. Raises StoreError."""
    table = compare_table(compared)
    texts = {
        "compare.md": to_markdown(table),
        "compare.tex": to_latex(table),
        "compare.csv": compare_csv(compared),
        "compare.json": json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n",
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        written = [folder / name for name in texts]
        with paper_column():
            figure = build_forest(compared)
            if figure:
                marked(figure, compared.origins.line)
                for suffix in ("png", "pdf"):
                    written.append(folder / f"compare.{suffix}")
                    figure.savefig(written[-1])
    except OSError as error:
        raise StoreError(f"`output` {folder}: {error.strerror}; name another folder") from error
    return written
