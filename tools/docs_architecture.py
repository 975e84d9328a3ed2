"""Draw docs/figures/architecture.png: the rooms of the core by floors, the plug-ins above them, and their imports.

`.venv/bin/python tools/docs_architecture.py`. Floors come from the import-linter contract in pyproject.toml, rooms and
arrows from the code, so the drawing cannot say what is not so.
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

from s2a_bench.writers.figures import new_figure
from s2a_bench.writers.style import paper_column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "s2a_bench"
DPI = 150
WIDTH_IN, FLOOR_IN = 7.2, 0.78
GROUND = "the ground"
PLUGINS = "plugins"
COLOURS = ("#56B4E9", "#E69F00", "#009E73", "#0072B2", "#CC79A7", "#D55E00", "#F0E442", "#999999")


def floors() -> list[list[str]]:
    """Return the rooms by floor, the top one first: the plug-ins; the ground's modules are one room."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    named = [
        [room.strip().removeprefix("s2a_bench.") for room in layer.replace(":", "|").split("|")] for layer in layers
    ]
    plug_ins = sorted(f"{PLUGINS}.{path.parent.name}" for path in (PACKAGE / PLUGINS).glob("*/__init__.py"))
    return [plug_ins, *named[:-1], [GROUND]]


def room_of(module: str, rooms: set[str]) -> str:
    """Return the room that a module of the package is in."""
    _, *inside = module.split(".")
    return next((room for room in (".".join(inside[:2]), *inside[:1]) if room in rooms), GROUND)


def arrows(rooms: set[str]) -> tuple[Counter[tuple[str, str]], Counter[str]]:
    """Count the imports from room to room, and the lines of each room."""
    found: Counter[tuple[str, str]] = Counter()
    lines: Counter[str] = Counter()
    for path in sorted(PACKAGE.rglob("*.py")):
        here = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts), rooms)
        text = path.read_text()
        lines[here] += text.count("\n")
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for name in names:
                if name.startswith("s2a_bench.") and (there := room_of(name, rooms)) != here:
                    found[here, there] += 1
    return found, lines


def draw() -> Figure:
    """Draw rooms as boxes and imports as arrows, thicker where there are more of them; the ground's are left out.

    Plug-ins are dashed, and their arrows grey.
    """
    plan = floors()
    rooms = {room for floor in plan for room in floor}
    imports, lines = arrows(rooms)
    title = "Rooms and arrows: everything imports downwards. Dashed: plug-ins, which nothing imports"
    figure = new_figure(FLOOR_IN * len(plan) + 0.3, (title,), WIDTH_IN)
    figure.suptitle(title, x=0.01, horizontalalignment="left")
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_xlim(0, 10)
    axes.set_ylim(-0.1, len(plan))
    place: dict[str, tuple[float, float]] = {}
    for height, floor in enumerate(reversed(plan)):
        for number, room in enumerate(floor):
            place[room] = ((number + 0.5) * 10 / len(floor), height + 0.45)
    for (here, there), count in sorted(imports.items()):
        if there == GROUND or place[here][1] <= place[there][1]:
            continue
        plug_in = here.startswith(PLUGINS)
        colour = "#BBBBBB" if plug_in else COLOURS[sorted(rooms).index(here) % len(COLOURS)]
        (x0, y0), (x1, y1) = place[here], place[there]
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
    for room, (x, y) in place.items():
        plug_in = room.startswith(PLUGINS)
        width = 9.6 if room == GROUND else 1.14 if plug_in else 1.7
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
        name, size = room.removeprefix(f"{PLUGINS}."), 7 if plug_in else 8
        axes.text(x, y + 0.06, name, ha="center", va="center", fontsize=size, weight="bold", zorder=3)
        axes.text(x, y - 0.12, f"{lines[room]:,} lines", ha="center", va="center", fontsize=6, zorder=3)
    return figure


def main() -> None:
    """Write the drawing."""
    path = ROOT / "docs" / "figures" / "architecture.png"
    with paper_column():
        draw().savefig(path, dpi=DPI)
    print(path)


if __name__ == "__main__":
    main()
