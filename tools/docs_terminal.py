"""Record what the README shows of a terminal: `.venv/bin/python tools/docs_terminal.py`, docs/figures/terminal.svg.

The command runs here and now; rich draws what it printed.
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text

DRAWING = Path(__file__).parent.parent / "docs" / "figures" / "terminal.svg"
WIDTH = 106
COMMAND = "latency --engine echo"
FORMAT = re.sub(r"@font-face \{\{.*?\}\}\s*", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL)
"""rich's own, without the fonts that it would fetch."""


def main() -> None:
    """Run the command as on a terminal and draw what it printed."""
    environment = os.environ | {"FORCE_COLOR": "1", "COLUMNS": str(WIDTH)}
    with TemporaryDirectory() as folder:
        line = [sys.executable, "-m", "s2a_bench", *COMMAND.split()]
        done = subprocess.run(line, cwd=folder, env=environment, capture_output=True, check=True, text=True)  # noqa: S603
    console = Console(record=True, width=WIDTH, file=io.StringIO())
    console.print(Text(f"$ s2a-bench {COMMAND}\n", style="bold"))
    console.print(Text.from_ansi(done.stdout))
    drawing = console.export_svg(title="s2a-bench", code_format=FORMAT, unique_id="terminal")
    DRAWING.write_text(drawing, encoding="utf-8")


if __name__ == "__main__":
    main()
