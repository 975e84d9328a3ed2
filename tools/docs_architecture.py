"""Draw docs/figures/architecture.png: the packages of the core by layer, the plug-ins above them, and their imports.

`.venv/bin/python tools/docs_architecture.py`. Layers come from the import-linter contract in pyproject.toml, packages
and arrows from the code. An import that follows from others (A of B, B of C: A of C) has no arrow.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image

from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.style import paper_column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "s2a_bench"
DPI = 110
WIDTH_IN, LAYER_IN = 7.2, 0.6
GROUND = "modules that all others use"
PLUGINS = "plugins"
COLOURS = ("#56B4E9", "#E69F00", "#009E73", "#0072B2", "#CC79A7", "#D55E00", "#F0E442", "#999999")

COLOURS_OF_FILE = 64
"""Colours of the file: a third of the bytes that all shades of lines take."""


def layers() -> list[list[str]]:
    """Return the packages by layer, the top one first: the plug-ins; the modules that all use are one box."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    lines = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    named = [
        [package.strip().removeprefix("s2a_bench.") for package in line.replace(":", "|").split("|")] for line in lines
    ]
    plug_ins = sorted(f"{PLUGINS}.{path.parent.name}" for path in (PACKAGE / PLUGINS).glob("*/__init__.py"))
    half = len(plug_ins) // 2
    return [plug_ins[:half], plug_ins[half:], *named[:-1], [GROUND]]


def package_of(module: str, packages: set[str]) -> str:
    """Return the package that a module is in."""
    _, *inside = module.split(".")
    return next((name for name in (".".join(inside[:2]), *inside[:1]) if name in packages), GROUND)


def arrows(packages: set[str]) -> tuple[Counter[tuple[str, str]], Counter[str]]:
    """Count the imports from package to package, and the lines of each."""
    imports: Counter[tuple[str, str]] = Counter()
    lines: Counter[str] = Counter()
    for path in sorted(PACKAGE.rglob("*.py")):
        package = package_of(".".join(path.relative_to(ROOT).with_suffix("").parts), packages)
        text = path.read_text()
        lines[package] += text.count("\n")
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for name in names:
                if name.startswith("s2a_bench.") and (imported := package_of(name, packages)) != package:
                    imports[package, imported] += 1
    return imports, lines


def without_indirect(imports: Counter[tuple[str, str]]) -> Counter[tuple[str, str]]:
    """Return the imports that do not follow from others."""
    below: dict[str, set[str]] = {}
    for package, imported in imports:
        below.setdefault(package, set()).add(imported)

    def reached(package: str) -> set[str]:
        return set().union(*({each} | reached(each) for each in below.get(package, ())))

    return Counter(
        {
            (package, imported): count
            for (package, imported), count in imports.items()
            if not any(imported in reached(each) for each in below[package])
        }
    )


def draw() -> Figure:
    """Draw packages as boxes and imports as arrows, thicker where there are more of them.

    Plug-ins are dashed, and their arrows grey.
    """
    plan = layers()
    packages = {package for layer in plan for package in layer}
    imports, lines = arrows(packages)
    title = "Packages and imports, which all lead downwards. Dashed: plug-ins, which nothing imports"
    figure = new_figure(LAYER_IN * len(plan) + 0.3, (title,), WIDTH_IN)
    figure.suptitle(title, x=0.01, horizontalalignment="left")
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_xlim(0, 10)
    axes.set_ylim(-0.1, len(plan))
    place: dict[str, tuple[float, float]] = {}
    for height, layer in enumerate(reversed(plan)):
        for number, package in enumerate(layer):
            place[package] = ((number + 0.5) * 10 / len(layer), height + 0.45)
    downwards = {
        (package, imported): count
        for (package, imported), count in imports.items()
        if imported != GROUND and place[package][1] > place[imported][1]
    }
    for (package, imported), count in sorted(without_indirect(Counter(downwards)).items()):
        plug_in = package.startswith(PLUGINS)
        colour = "#BBBBBB" if plug_in else COLOURS[sorted(packages).index(package) % len(COLOURS)]
        (x0, y0), (x1, y1) = place[package], place[imported]
        axes.add_patch(
            FancyArrowPatch(
                (x0, y0 - 0.22),
                (x1, y1 + 0.24),
                connectionstyle=f"arc3,rad={0.12 if x1 >= x0 else -0.12}",
                arrowstyle="-|>,head_length=3,head_width=1.6",
                linewidth=0.4 + 0.25 * min(count, 12) ** 0.5,
                color=colour,
                alpha=0.65,
                zorder=0 if plug_in else 1,
            )
        )
    for package, (x, y) in place.items():
        plug_in = package.startswith(PLUGINS)
        width = 9.6 if package == GROUND else 1.7
        box = FancyBboxPatch(
            (x - width / 2, y - 0.22),
            width,
            0.44,
            "round,pad=0,rounding_size=0.08",
            fc="white",
            ec="black",
            lw=0.7,
            ls="--" if plug_in else "-",
            zorder=2,
        )
        axes.add_patch(box)
        name = package.removeprefix(f"{PLUGINS}.")
        axes.text(x, y + 0.06, name, ha="center", va="center", fontsize=8, weight="bold", zorder=3)
        axes.text(x, y - 0.12, f"{lines[package]:,} lines", ha="center", va="center", fontsize=6, zorder=3)
    return figure


def main() -> None:
    """Write the drawing."""
    path = ROOT / "docs" / "figures" / "architecture.png"
    with paper_column():
        draw().savefig(path, dpi=DPI)
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(COLOURS_OF_FILE).save(path, optimize=True)
    print(path)


if __name__ == "__main__":
    main()
