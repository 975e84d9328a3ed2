"""Write the flag tables of docs/*.md from the declarations: `.venv/bin/python tools/docs_flags.py`.

A table stands between `<!-- flags: COMMAND -->` and `<!-- /flags -->`. `timeline Live` has only the flags of the class
Live, which the configuration is derived from, `timeline -Live` all others.
"""

from __future__ import annotations

import re
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from typer.main import get_command

from s2a_bench.cli import app
from s2a_bench.experiments import EXPERIMENTS

DOCS = Path(__file__).parent.parent / "docs"
TABLE = re.compile(r"(<!-- flags: (\S+)(?: (-?)(\w+))? -->\n).*?(<!-- /flags -->)", re.DOTALL)
DEFAULT = re.compile(r" ?\[default: ([^\]]*)\]")


def table(command: str, without: str = "", group: str = "") -> str:
    """Return the table of a command's flags."""
    commands: Any = get_command(app)
    config = resolve_name(EXPERIMENTS[command].config)
    chosen = next((set(base.model_fields) for base in config.__mro__ if base.__name__ == group), set())
    lines = ["| flag | default | meaning |", "|---|---|---|"]
    for parameter in commands.get_command(None, command).params:
        if not group or (parameter.name.partition("__")[0] in chosen) is not bool(without):
            about = (parameter.help or "").removeprefix(f"--{group.lower()}: ")
            default = DEFAULT.search(about)
            given = default[1] if default else "" if parameter.default in (None, False) else str(parameter.default)
            meaning = DEFAULT.sub("", about).replace("|", "\\|")
            lines.append(f"| `{parameter.opts[0]}` | {given.replace(',', ', ')} | {meaning} |")
    return "\n".join(lines)


def written(text: str) -> str:
    """Return a page with its tables as the declarations have them."""
    return TABLE.sub(lambda found: f"{found[1]}{table(found[2], found[3] or '', found[4] or '')}\n{found[5]}", text)


def main() -> None:
    """Write every page anew whose tables have changed."""
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := written(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(page)


if __name__ == "__main__":
    main()
