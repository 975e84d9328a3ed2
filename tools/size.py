"""Print how large the product is, room by room: lines, lines of code, files; `studies/` and `tools/` beside it.

It fails if there are more lines than `BUDGETS` allow, so that weight is a decision. The core is all but the plug-ins.

Lines of code are those with a token that is neither a comment nor part of a docstring. ``make check`` prints the table;
a room is a folder of `s2a_bench/`, or the modules beside them.
"""

from __future__ import annotations

import ast
import io
import subprocess
import tokenize
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = "s2a_bench"
BESIDE = ("studies", "tools", "benchmarks", "tests")
BUDGETS = {"s2a_bench": 58_180, "core": 41_390, "tests": 51_600}
"""Lines: of the product, of its core, and of the tests."""
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


@dataclass(slots=True)
class Size:
    """What files come to."""

    lines: int = 0
    code: int = 0
    files: int = 0

    def add(self, other: Size) -> None:
        """Add other files."""
        self.lines += other.lines
        self.code += other.code
        self.files += other.files


def size_of(text: str) -> Size:
    """Return the size of one file."""
    docstrings = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            code.update(range(token.start[0], token.end[0] + 1))
    return Size(len(text.splitlines()), len(code - docstrings), 1)


def room_of(path: Path) -> str:
    """Return the room of a file: the folder under the product, a kind of experiment, or what stands beside it."""
    top, *inside = path.parts
    if top != PRODUCT:
        return top
    depth = 2 if inside[0] in {"experiments", "plugins", "report", "transport"} else 1
    return "/".join(inside[:-1][:depth]) or "(top)"


def rooms() -> dict[str, Size]:
    """Return the size of every room, of tracked files."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"],  # noqa: S607
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    found: dict[str, Size] = defaultdict(Size)
    for name in listed:
        path = Path(name)
        if path.parts[0] in {PRODUCT, *BESIDE} and (ROOT / path).exists():
            found[room_of(path)].add(size_of((ROOT / path).read_text(encoding="utf-8")))
    return found


def sums(found: dict[str, Size]) -> dict[str, Size]:
    """Return the sizes of the core and of the product."""
    core, total = Size(), Size()
    for name, size in found.items():
        total.add(size)
        if not name.startswith("plugins"):
            core.add(size)
    return {"core": core, PRODUCT: total}


def table(found: dict[str, Size]) -> str:
    """Return the table of all rooms."""
    beside = {name: found[name] for name in BESIDE if name in found}
    product = {name: size for name, size in found.items() if name not in BESIDE}
    rows = [*sorted(product.items(), key=lambda row: -row[1].lines), *sums(product).items(), *beside.items()]
    head = f"{'room':32}{'lines':>8}{'code':>8}{'files':>7}"
    return "\n".join([head, *(f"{name:32}{size.lines:8}{size.code:8}{size.files:7}" for name, size in rows)])


def excess(found: dict[str, Size]) -> list[str]:
    """Return a line for each budget that is exceeded."""
    counted = found | sums({name: size for name, size in found.items() if name not in BESIDE})
    over = {name: counted[name].lines - most for name, most in BUDGETS.items() if counted[name].lines > most}
    return [f"{name} has {lines} lines more than its budget of {BUDGETS[name]}" for name, lines in over.items()]


if __name__ == "__main__":
    sizes = rooms()
    print(table(sizes))
    raise SystemExit("\n".join(excess(sizes)) or None)
