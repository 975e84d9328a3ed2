"""What is not imported: heavy libraries before they are needed, and optional ones but through one function."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import s2a_bench

HEAVY = ("numpy", "cv2", "pandas", "matplotlib", "pydantic", "llama_cpp", "cyclonedds")
OPTIONAL = {
    *("gguf", "huggingface_hub", "llama_cpp", "highway_env", "gymnasium", "pygame", "pynvml", "json_numpy", "ray"),
    *("carla", "xllamacpp"),
}
TYPES = "TYPE_CHECKING"


def imported(code: str) -> list[str]:
    """Run code in a fresh Python; return the heavy packages that it imported."""
    program = f"import sys\n{code}\nprint([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    names: list[str] = ast.literal_eval(done.stderr)
    return names


def test_the_package_itself_imports_nothing_heavy() -> None:
    assert imported("import s2a_bench") == []


def test_help_imports_nothing_heavy() -> None:
    run = "sys.argv = ['s2a-bench', '--help']\nfrom s2a_bench.cli import main\n"
    run += "try:\n    main()\nexcept SystemExit:\n    pass"
    assert imported(run) == []


def statements(tree: ast.AST, *, late: bool = True) -> Iterator[ast.stmt]:
    """Yield the import statements that are carried out, also those in functions, which are carried out ``late``."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif late or not isinstance(node, ast.FunctionDef):
            types_only = isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == TYPES
            yield from statements(node, late=late) if not types_only else ()


def modules(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.ImportFrom):
        return {(statement.module or "").partition(".")[0]} if not statement.level else set()
    assert isinstance(statement, ast.Import)
    return {alias.name.partition(".")[0] for alias in statement.names}


LIBRARIES = {
    *(*HEAVY, *OPTIONAL, "scipy", "rich", "httpx", "zmq", "websockets", "fastapi", "uvicorn", "rosbags", "ruamel"),
    *("pyarrow", "jinja2", "zenoh", "rclpy"),
}
LATE = {
    "s2a_bench.harness.config": "it loads every transport, those of other packages too",
}
"""Modules that may be imported in a function though no heavy library stands behind them, and why."""
TO_BE_MOVED = ("s2a_bench/experiments/", "s2a_bench/policy/", "s2a_bench/transport/", "s2a_bench/__init__.py")
"""Modules that still do so for other reasons, and the package's face, of which a name is looked up."""


def named(statement: ast.stmt) -> set[str]:
    """Return the modules, and perhaps attributes, that a statement names, with the packages that they are in."""
    names = [alias.name for alias in getattr(statement, "names", ())]
    if isinstance(statement, ast.ImportFrom):
        names = [str(statement.module), *(f"{statement.module}.{name}" for name in names)]
    return {".".join(name.split(".")[:depth]) for name in names for depth in range(1, name.count(".") + 2)}


@cache
def imported_with(name: str) -> frozenset[str]:
    """Return what a module of ours names in the imports that its own import carries out, optional libraries too."""
    path = Path(name.replace(".", "/"))
    source = next((each for each in (path.with_suffix(".py"), path / "__init__.py") if each.exists()), None)
    if source is None:
        return frozenset()
    tree = ast.parse(source.read_text())
    required = (re.match(r"\w+ = extras.require\('(\w+)", ast.unparse(node)) for node in tree.body)
    names = {found[1] for found in required if found}
    return frozenset(names.union(*(named(statement) for statement in statements(tree, late=False))))


def brings(names: set[str]) -> set[str]:
    """Return the heavy libraries that come with modules, through whatever they import."""
    seen: set[str] = set()
    while names:
        seen |= names
        names = set().union(*map(imported_with, names)) - seen
    return seen & LIBRARIES


def test_own_modules_are_imported_late_only_where_that_spares_a_heavy_library() -> None:
    found = []
    for path in Path("s2a_bench").rglob("*.py"):
        module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
        tree = ast.parse(path.read_text())
        for statement in {*statements(tree)} - {*statements(tree, late=False)}:
            names = named(statement)
            if "s2a_bench" in names and names.isdisjoint(LATE) and not brings(names) - brings({module}):
                found.append(f"{path}:{statement.lineno}")
    assert [each for each in found if not each.startswith(TO_BE_MOVED)] == [], "import these above"


@pytest.mark.parametrize("path", sorted(Path(s2a_bench.__file__).parent.rglob("*.py")), ids=str)
def test_no_module_imports_an_optional_library_by_a_statement(path: Path) -> None:
    for statement in statements(ast.parse(path.read_text())):
        assert not modules(statement) & OPTIONAL, f"line {statement.lineno}: see s2a_bench/extras.py"
