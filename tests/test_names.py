"""Consumers trust declarations: no experiment uses another one, and nobody names one policy, mode, engine and so on.

Research and plug-ins stand outside, and may name what they are about: `studies` and each of `s2a_bench.plugins` import
what docs/library.md lists, and the package never imports `studies`; that it imports no plug-in is a contract of
import-linter.

What is named is read off the syntax tree: modules that are imported, wherever, and texts that are a registered name.
`tests/data/names.txt` is what may, as a default or a claim has to name one, and what is still to be moved: it shrinks.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import s2a_bench
from s2a_bench.act import ROBOTS
from s2a_bench.experiments import EXPERIMENTS
from s2a_bench.frames import SOURCES
from s2a_bench.inference import ENGINES
from s2a_bench.plugins.chunks.modes import MODES
from s2a_bench.policy import POLICIES
from s2a_bench.ros import MIDDLEWARES
from s2a_bench.transport import TRANSPORTS

ROOT = Path(__file__).parent.parent
ALLOWED = Path(__file__).parent / "data" / "names.txt"
HOMES = {
    *(f"s2a_bench.experiments.{path.parent.name}" for path in ROOT.glob("s2a_bench/experiments/*/__init__.py")),
    *(each.run.partition(":")[0].rpartition(".")[0] for _, each in EXPERIMENTS.loaded()),
}
"""The packages of experiments."""
COMMON = {"queue", "replace"}
"""Modes whose names are words of other things too (a stage, an error handler): seen where they are imported only."""
OTHERS = {"s2a_bench/act/": ROBOTS, "s2a_bench/frames/": SOURCES, "s2a_bench/plugins/chunks/modes/": POLICIES}
"""Where a name is a robot's, a camera's or a parameter's value, whatever else is called so."""
KINDS = {
    "policy": (POLICIES, "s2a_bench/policy/"),
    "mode": (MODES, "s2a_bench/plugins/chunks/"),
    "engine": (ENGINES, "s2a_bench/inference/"),
    "transport": (TRANSPORTS, "s2a_bench/transport/{}/"),
    "middleware": (MIDDLEWARES, "s2a_bench/ros/"),
}


def imported(nodes: list[ast.AST]) -> set[str]:
    """Return what is imported, as module.name."""
    found = {
        f"{node.module}.{alias.name}" for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    return found | {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}


def within(name: str, module: str) -> bool:
    """Whether a name is a module or in it."""
    return name == module or name.startswith(f"{module}.")


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imports_of(path: Path) -> set[str]:
    return imported(nodes_of(path))


def named(path: Path) -> Iterator[str]:
    """Yield what a module names that it should not have to."""
    nodes = nodes_of(path)
    prose = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    where = path.relative_to(ROOT).as_posix()
    modules = set() if where.startswith("s2a_bench/plugins/") else imports_of(path)  # of a plug-in: the test below
    texts = {
        node.value
        for node in nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose
    }
    for kind, (registry, home) in KINDS.items():
        declared = "s2a_bench/transport/__init__.py" if kind == "transport" else home
        shipped = {
            name: point.value for name, point in registry._offered.items() if within(point.module, "s2a_bench.plugins")
        }
        for name, target in {**registry._builtins, **shipped}.items():
            plug_in = "/".join(re.split("[.:]", target)[:3]) + "/"
            if where.startswith((plug_in,) if name in shipped else (home.format(name), declared)):
                continue
            opened = registry[name].opens if kind == "middleware" else target
            module = opened.partition(":")[0]
            elsewhere = any(where.startswith(at) and name in kinds.built_in() for at, kinds in OTHERS.items())
            if any(within(each, module) for each in modules) or (
                name in texts and name not in COMMON and not elsewhere
            ):
                yield f"{kind} {name}"
    for mine in HOMES:
        if where.startswith(f"{mine.replace('.', '/')}/"):
            others = {home for home in HOMES - {mine} if any(within(each, home) for each in modules)}
            yield from (f"experiment {home.rpartition('.')[2]}" for home in others)


def test_nobody_in_the_core_names_one_of_a_kind_but_where_it_is_allowed() -> None:
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {', '.join(sorted(names))}"
        for path in (ROOT / "s2a_bench").rglob("*.py")
        if "plugins" not in path.parts and (names := set(named(path)))
    }
    allowed = {line for line in ALLOWED.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")}
    assert not found - allowed, "a declaration lacks an attribute, or a module belongs elsewhere"
    assert not allowed - found, "no longer so: take the lines out"


PLUGINS = sorted(path.parent for path in (ROOT / "s2a_bench" / "plugins").glob("*/__init__.py"))


def listed(heading: str) -> set[str]:
    """Return the modules of a table of docs/library.md."""
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    section = page.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    return set(re.findall(r"^\| `(s2a_bench[\w.]+)` \|", section, re.MULTILINE))


def is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.is_dir() or path.with_suffix(".py").is_file()


@pytest.mark.parametrize("folder", [ROOT / "studies", *PLUGINS], ids=lambda path: path.name)
def test_studies_and_plug_ins_import_the_documented_modules_alone(folder: Path) -> None:
    public, for_plug_ins = listed("Modules for programs of your own"), listed("Modules for plug-ins")
    face = {"s2a_bench", *(f"s2a_bench.{name}" for name in s2a_bench.__all__)}
    mine = ".".join(folder.relative_to(ROOT).parts)
    single = for_plug_ins if folder in PLUGINS else set()
    found = {
        f"{path.name}: {name}"
        for path in folder.rglob("*.py")
        for name in imports_of(path)
        if within(name, "s2a_bench")
        and name not in face | single
        and not any(within(name, module) for module in (*public, mine))
        and (name.rpartition(".")[0] not in single or is_module(name))
    }
    assert {"s2a_bench.policy", "s2a_bench.store"} <= public
    assert not found, "docs/library.md does not list these modules"


def test_the_modules_that_are_listed_exist() -> None:
    every = listed("Modules for programs of your own") | listed("Modules for plug-ins")
    assert {name for name in every if not is_module(name)} == set()


def test_the_package_never_imports_the_studies() -> None:
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in (ROOT / "s2a_bench").rglob("*.py")
        for name in imports_of(path)
        if within(name, "studies")
    }
    assert not found
