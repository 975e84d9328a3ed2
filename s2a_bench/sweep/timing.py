"""How long a sweep will take: as cells took before, or as one virtual cell run for it takes; else nobody knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from s2a_bench.errors import StoreError
from s2a_bench.machine import environment
from s2a_bench.store.sweep import Sweep, read_sweep
from s2a_bench.sweep import Cell, Workers
from s2a_bench.sweep.machine import difference, facts_of


@dataclass(frozen=True, slots=True)
class Expected:
    """A time to expect, and where it is from; None: not known."""

    seconds: float | None
    source: str


def earlier(output: Path, command: str) -> list[Sweep]:
    """Find sweeps of a command on this machine below a folder, the newest first."""
    here = facts_of(environment.collect())
    found = []
    for folder in sorted(output.glob("*-sweep-*"), reverse=True):
        try:
            sweep = read_sweep(folder)
        except StoreError:
            continue
        asked = sweep.manifest["configuration"].get("command")
        if asked == command and not difference(here, facts_of(sweep.manifest["environment"])):
            found.append(sweep)
    return found


def expect(cells: Sequence[Cell], rest_s: float, width: int, sweeps: Sequence[Sweep], workers: Workers) -> Expected:
    """Return how long cells will take, by the times of the same cells, of the same command, or of the first."""
    for sweep in sweeps:
        done = sweep.cells[sweep.cells["state"] == "finished"]
        if len(done):
            times = {str(name): float(value) for name, value in done.groupby("config_hash")["wall_s"].median().items()}
            typical = float(done["wall_s"].median())
            known = sum(cell.config_hash in times for cell in cells)
            source = f"as {known} of these cells took in {sweep.path}"
            if known < len(cells):
                source += f", {typical:.1f} s for each of the others"
            spent = [(cell, times.get(cell.config_hash, typical)) for cell in cells]
            return Expected(_total(spent, rest_s, width), source)
    first = next((cell for cell in cells if cell.virtual), None)
    if first is None:
        return Expected(None, "no sweep of this command has run here; once a cell is done, the time left is shown")
    with TemporaryDirectory(prefix="s2a-bench-sweep-") as place, workers:
        turns = [
            workers.collect(workers.submit(first, folder), folder).wall_s
            for folder in (Path(place) / "first", Path(place) / "second")
        ]
    source = f"cell {first.name} was run for it and took {turns[1]:.2f} s, not counting the first time"
    start_s = turns[0] - turns[1]
    return Expected(_total([(cell, turns[1]) for cell in cells], rest_s, width) + max(start_s, 0), source)


def _total(spent: Sequence[tuple[Cell, float]], rest_s: float, width: int) -> float:
    """Add up: measured cells one after another on their board, boards side by side, then virtual ones."""
    boards: dict[str, float] = {}
    for cell, seconds in spent:
        if not cell.virtual:
            boards[cell.board] = boards.get(cell.board, -rest_s) + seconds + rest_s
    virtual = [seconds for cell, seconds in spent if cell.virtual]
    return max(boards.values(), default=0.0) + sum(virtual) / min(width, max(len(virtual), 1))
