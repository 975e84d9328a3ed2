"""A sweep: one row a cell with its settings, and the run folder of each."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.errors import StoreError
from s2a_bench.provenance import Origins, joined
from s2a_bench.store.manifest import SWEEP
from s2a_bench.store.run import StoredRun, fits, read_run
from s2a_bench.store.schema import Table

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True)
class CellRow:
    """One attempt at one cell of a sweep; the latest attempt counts.

    ``cell`` and ``repeat`` identify the cell. ``state`` is finished or failed, ``error`` the reason. ``board`` is the
    machine that the cell needs, empty for any; ``host`` is the machine that ran it. ``folder`` is its run folder below
    the sweep's, empty if it has none; ``provenance`` is that of the run.
    """

    cell: str
    repeat: int
    attempt: int
    state: str
    error: str
    virtual: bool
    board: str
    host: str
    settings: dict[str, Any]
    argv: list[str]
    config_hash: str
    folder: str
    started: str
    wall_s: float
    provenance: str = ""


CELLS: Final[Table[CellRow]] = Table("cells", CellRow)


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep: the manifest, every attempt (`CELLS`), and the cells.

    ``cells`` has the latest attempt of each cell and repeat, and a column more for every setting, by its flag's name.
    """

    path: Path
    manifest: dict[str, Any]
    attempts: pd.DataFrame
    cells: pd.DataFrame

    @property
    def origins(self) -> Origins:
        return joined(run.origins for _, run in self.runs())

    def runs(self) -> Iterator[tuple[dict[str, Any], StoredRun]]:
        for row in self.cells[self.cells["state"] == "finished"].to_dict("records"):
            yield json.loads(row["settings"]), read_run(self.path / row["folder"])


def is_sweep(manifest: dict[str, Any]) -> bool:
    return bool(manifest.get("command") == SWEEP)


def read_sweep(path: Path) -> Sweep:
    """Read a sweep's folder, finished or not; raises StoreError if it is not one."""
    import pandas as pd

    run = read_run(path)
    if not is_sweep(run.manifest):
        raise StoreError(f"{path} is the folder of a {run.manifest['command']} run, not of a sweep")
    attempts = run.table(CELLS)
    cells = attempts.drop_duplicates(["cell", "repeat"], keep="last").sort_values(["cell", "repeat"], ignore_index=True)
    with fits(run):
        settings = pd.DataFrame([json.loads(text) for text in cells["settings"]], index=cells.index)
    new = [name for name in settings.columns if name not in cells.columns]
    return Sweep(Path(path), run.manifest, attempts, cells.join(settings[new]))
