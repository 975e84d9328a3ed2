"""Write the tables of flags and facts in docs/*.md from the declarations: `.venv/bin/python tools/docs_flags.py`.

A table of flags stands between `<!-- flags: COMMAND -->` and `<!-- /flags -->`, that of the facts between
`<!-- facts -->` and `<!-- /facts -->`. `timeline LiveOptions` has only the flags of that class, which the configuration
is derived from or has as a group, `timeline -LiveOptions` all others; `throughput -latency` has the flags that latency
has not, or has otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from typer.main import get_command

from s2a_bench.cli import app
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.facts import FRAMES_LOST, FRAMES_PUBLISHED, Fact
from s2a_bench.inference import ENGINES
from s2a_bench.machine.resources import SPENT
from s2a_bench.options import Options, group_of
from s2a_bench.transport import TRANSPORTS
from s2a_bench.transport.http.dialects import DIALECTS

DOCS = Path(__file__).parent.parent / "docs"
TABLE = re.compile(r"(<!-- flags: (\S+)(?: (-?)(\w+))? -->\n).*?(<!-- /flags -->)", re.DOTALL)
FACTS = re.compile(r"(<!-- facts -->\n).*?(<!-- /facts -->)", re.DOTALL)
DEFAULT = re.compile(r" ?\[default: ([^\]]*)\]")
COMMA = re.compile(r", *")
PREFIX = re.compile(r"^--live: ")
"""What the help of a group's flags begins with, and its table has above it."""


def table(command: str, without: str = "", group: str = "") -> str:
    """Return the table of a command's flags."""
    rows = flags(command)
    chosen = [row for name, row in rows.items() if _belongs(command, name, row, group) is not bool(without)]
    return "\n".join(["| flag | default | meaning |", "|---|---|---|", *chosen])


def flags(command: str) -> dict[str, str]:
    """Return the row of every flag and argument that sets something and is not hidden, by the parameter's name."""
    commands: Any = get_command(app)
    rows = {}
    for parameter in commands.get_command(None, command).params:
        if parameter.expose_value and not getattr(parameter, "hidden", False):
            about = PREFIX.sub("", parameter.help or "")
            default = DEFAULT.search(about)
            given = default[1] if default else "" if parameter.default in (None, False) else str(parameter.default)
            meaning = DEFAULT.sub("", about).replace("|", "\\|")
            name = parameter.metavar if parameter.param_type_name == "argument" else parameter.opts[0]
            rows[parameter.name] = f"| `{name}` | {COMMA.sub(', ', given)} | {meaning} |"
    return rows


def _belongs(command: str, name: str, row: str, group: str) -> bool:
    """Whether a flag is of a group: a class of options, or another command."""
    if not group:
        return True
    if group in EXPERIMENTS:
        return row in flags(group).values()
    config = resolve_name(EXPERIMENTS[command].config)
    field = name.partition("__")[0]
    bases = {base.__name__: base.model_fields for base in config.__mro__ if issubclass(base, Options)}
    inner = field in config.model_fields and group_of(config.model_fields[field])
    return field in bases.get(group, ()) or bool(inner and inner.__name__ == group)


def fact_table() -> str:
    """Return the table of the facts, in the order in which they come to be told."""
    tellers: dict[str, Sequence[Fact]] = {name: TRANSPORTS[name].facts for name in TRANSPORTS.built_in()}
    tellers |= {name: DIALECTS[name]().facts for name in DIALECTS.built_in()}
    tellers |= {name: ENGINES[name].declared_facts for name in ENGINES.built_in()}
    tellers |= {"`--mode stream`": (FRAMES_PUBLISHED, FRAMES_LOST), "[resources](resources.md)": SPENT}
    lines = ["| fact | unit | what it says | told by |", "|---|---|---|---|"]
    for fact in dict.fromkeys(fact for told in tellers.values() for fact in told):
        names = ", ".join(name for name, told in tellers.items() if fact in told)
        lines.append(f"| `{fact}` | {fact.unit} | {fact.about} | {names} |")
    return "\n".join(lines)


def written(text: str) -> str:
    """Return a page with its tables as the declarations have them."""
    text = FACTS.sub(lambda found: f"{found[1]}{fact_table()}\n{found[2]}", text)
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
