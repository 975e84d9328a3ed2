"""The format of a run that is shared: a run folder of CSV tables, whose manifest has the SHA-256 of each.

docs/share.md explains it, docs/schema/s2a-bench-export-1.json follows from `ExportedRun`.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import TypeAdapter, ValidationError

from s2a_bench.bounds import Count, Facts, about
from s2a_bench.errors import StoreError
from s2a_bench.provenance import Origins
from s2a_bench.store.manifest import NAME, RunWarning

KEY: Final = "export"
"""The key of a manifest that an export wrote."""
WITHHELD: Final = "withheld"
"""What stands in an exported run for a text that is not shared."""
FORMAT: Final = "s2a-bench-export/1"
TABLE: Final = re.compile(r"[a-z][a-z0-9_]*\.csv")
"""The name of a table's file."""


@dataclass(frozen=True)
class ExportedFile:
    """Size and checksum of a file."""

    bytes: Count
    sha256: Annotated[str, Facts(pattern="^[0-9a-f]{64}$")]

    @classmethod
    def of(cls, path: Path) -> ExportedFile:
        """Read a file piece by piece; raises OSError."""
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while piece := file.read(1 << 20):
                digest.update(piece)
            return cls(file.tell(), digest.hexdigest())


@dataclass(frozen=True)
class Export:
    """The version of this format, and the tables beside the manifest."""

    schema: Literal["s2a-bench-export/1"]
    files: Annotated[dict[str, ExportedFile], Facts(propertyNames={"pattern": f"^{TABLE.pattern}$"})]


@dataclass(frozen=True, kw_only=True)
class ExportedRun:
    """The manifest of a run that is shared, explained in docs/share.md. A text that is not shared is `withheld`."""

    schema: Literal["s2a-bench/1"]
    export: Export
    command: str
    state: Literal["running", "finished", "interrupted", "failed"]
    started: Annotated[str, about("UTC.")]
    finished: str | None = None
    configuration: dict[str, Any]
    environment: dict[str, Any]
    seeds: dict[str, Any]
    warnings: list[RunWarning]
    stages: Annotated[dict[str, str] | None, about("Stage -> group, in the order of the path.")] = None
    facts: Annotated[dict[str, Any] | None, about("Unit and meaning of each fact of a request.")] = None
    model: Annotated[dict[str, Any] | None, about("With the SHA-256 of its files.")] = None
    provenance: Annotated[Origins | None, about("Of the run, and of its cells if they differ.")] = None
    boards: list[dict[str, Any]] | None = None
    service: dict[str, Any] | str | None = None
    mark_cost_ns: float | None = None
    step_s: float | None = None


_FACTS: Final = """
tuning resources flash_attention calibrations start_jitter executions live prior request requests studies robot
reference link sends tap topics
"""
FACTS: Final = tuple(_FACTS.split())
"""Further keys of an exported manifest, each an object as in that of a run."""


def check(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Raise StoreError if a table of an exported run is missing, changed or not in its manifest."""
    if KEY not in manifest:
        return
    try:
        files = TypeAdapter(Export).validate_python(manifest[KEY]).files
    except ValidationError as error:
        where = ".".join(map(str, (KEY, *error.errors()[0]["loc"])))
        raise StoreError(f"{folder / NAME} is damaged: {where[:80]}: {error.errors()[0]['msg']}") from None
    for path in (folder / name for name in sorted({*files, *tables_in(folder)})):
        if path.name not in files or not TABLE.fullmatch(path.name):
            raise StoreError(f"{path} is not among the files of {folder / NAME}: remove it, or fetch the folder again")
        try:
            same = ExportedFile.of(path) == files[path.name]
        except OSError as error:
            raise StoreError(f"cannot read {path}: {error.strerror}; fetch the folder again") from error
        if not same:
            raise StoreError(f"{path} has changed since its export (SHA-256); fetch the folder again")


def tables_in(folder: Path) -> list[str]:
    """Return the names of the files in which a run folder may have tables."""
    return sorted(path.name for kind in ("*.csv", "*.parquet") for path in folder.glob(kind))
