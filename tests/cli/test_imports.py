"""What is not imported: heavy libraries before they are needed, and optional ones but through one function."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import s2a_bench

HEAVY = ("numpy", "cv2", "pandas", "pyarrow", "scipy", "matplotlib", "pydantic", "llama_cpp", "cyclonedds")
OPTIONAL = {
    *("gguf", "huggingface_hub", "llama_cpp", "highway_env", "gymnasium", "pygame", "pynvml", "json_numpy", "ray"),
    *("carla", "xllamacpp"),
}


def imported(code: str) -> list[str]:
    """Run code in a fresh Python; return the heavy packages that it imported."""
    program = f"import sys\n{code}\nprint([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    names: list[str] = ast.literal_eval(done.stderr)
    return names


HELP = """
sys.argv = ['s2a-bench', '--help']
from s2a_bench.cli import main
try:
    main()
except SystemExit:
    pass
"""


@pytest.mark.parametrize(
    ("code", "needed"),
    [
        ("import s2a_bench", set()),
        (HELP, set()),
        ("import s2a_bench.store.run, s2a_bench.report", {"pydantic"}),
        ("import s2a_bench.frames", {"pydantic", "numpy"}),
    ],
)
def test_nothing_heavy_is_imported_before_it_is_needed(code: str, needed: set[str]) -> None:
    assert {*imported(code)} <= needed


def statements(tree: ast.AST) -> Iterator[ast.stmt]:
    """Yield the import statements that are carried out, also those in functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif not (isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
            yield from statements(node)


def modules(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.ImportFrom):
        return {(statement.module or "").partition(".")[0]} if not statement.level else set()
    assert isinstance(statement, ast.Import)
    return {alias.name.partition(".")[0] for alias in statement.names}


def test_no_module_imports_an_optional_library_by_a_statement() -> None:
    for path in Path(s2a_bench.__file__).parent.rglob("*.py"):
        for statement in statements(ast.parse(path.read_text())):
            assert not modules(statement) & OPTIONAL, f"{path}, line {statement.lineno}: see s2a_bench/extras.py"
