"""A run folder: made before measuring, appended row by row, readable at any moment, even after a kill."""

from __future__ import annotations

import os
import re
import shutil
import socket
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, final

from s2a_bench.errors import MissingExtra, StoreError
from s2a_bench.provenance import Origins
from s2a_bench.store import export, files
from s2a_bench.store import manifest as manifests
from s2a_bench.store.requests import TOKENS, FrameRow, SampleRow, TokenRow, frames_table, samples_table
from s2a_bench.store.schema import PROVENANCE, SCHEMA, Kind, Row, Table

if TYPE_CHECKING:
    import pandas as pd

Ended: TypeAlias = Literal["finished", "interrupted", "failed"]


@final
class RunWriter(AbstractContextManager["RunWriter"]):
    """Writes one run folder, as a context manager; not thread-safe.

    Leaving the block finishes the run, unless `finish` was called before: "finished", "interrupted" on
    KeyboardInterrupt, "failed" on any other exception. A folder made by `create` is removed on an exception before the
    first row, unless it holds a folder.
    """

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        """Open an existing folder; raises StoreError if it cannot be written."""
        self.path = path
        self._manifest = manifest
        self._finished = False
        self._created: Sequence[Path] = ()
        self._rows = 0
        self._codes: dict[str, str] = {}
        try:
            files.reserve(path)
        except OSError as error:
            files.release(path)
            raise StoreError(f"cannot write into {path}: {files.why(error, path)}") from error
        manifests.write(path, manifest)
        self._files: dict[str, tuple[Table[Any], files.CsvFile]] = {}
        stages = manifest.get("stages", {})
        self._samples, self._frames = samples_table(stages), frames_table(stages)

    @classmethod
    def create(
        cls, root: Path, command: str, manifest: dict[str, Any], tables: Iterable[Table[Any]] | None = None
    ) -> RunWriter:
        """Make ``<root>/<UTC time>-<command>-<host>`` and open the files of ``tables``, by default those of requests.

        Other tables open at their first row. ``manifest`` may have ``stages`` (stage -> group; each is a column of the
        samples), ``provenance`` (`Origins.to_manifest`), ``argv``, ``configuration``, ``environment``, ``warnings``,
        ``seeds`` and more. Raises StoreError, naming ``--output``, if the folder cannot be made.
        """
        host = socket.gethostname()
        stem = f"{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}-{_slug(command)}-{_slug(host)}"
        try:
            created = [folder for folder in (Path(root), *Path(root).parents) if not folder.exists()]
            path = _make_unique(Path(root), stem)
        except (FileExistsError, NotADirectoryError) as error:
            raise StoreError(f"`output` {root}: {error.filename} is not a folder; name another one") from error
        except OSError as error:
            raise StoreError(f"`output` {root}: cannot create a folder there: {files.why(error, root)}") from error
        whole: dict[str, Any] = {
            "schema": SCHEMA,
            "command": command,
            "argv": manifests.plain(sys.argv),
            "host": host,
            "state": "running",
            "error": None,
            "started": manifests.utc_now(),
            "finished": None,
            "configuration": {},
            "environment": {},
            "seeds": {},
            "warnings": [],
        }
        manifests.merge(whole, manifest)
        run = cls(path, whole)
        run._created = (path, *created)
        for table in (run._samples, TOKENS) if tables is None else tables:
            run.append(table, [])
        return run

    @classmethod
    def reopen(cls, path: Path, tables: Iterable[Table[Any]]) -> RunWriter:
        """Resume a run folder with its manifest and the whole records of ``tables``; no other process may write it.

        Raises StoreError if it is not a run folder, of another version, or cannot be written.
        """
        manifest = manifests.read(path) | {"state": "running", "error": None, "finished": None}
        run = cls(path, manifest)
        for table in tables:
            (path / f"{table.name}.parquet").unlink(missing_ok=True)
            if (path / f"{table.name}.csv").exists():
                run._files[table.name] = table, files.CsvFile(path / f"{table.name}.csv", table.columns, reopen=True)
        return run

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest as last written; `update` changes it."""
        return self._manifest

    def append(self, table: Table[Row], rows: Iterable[Row]) -> None:
        """Append rows to a table in one write; the first call creates the file."""
        if table.name not in self._files:
            self._files[table.name] = table, files.CsvFile(self.path / f"{table.name}.csv", table.columns)
        kept = [*rows]
        self._files[table.name][1].append(table, kept, self._provenance)
        self._rows += len(kept)

    def _provenance(self, row: object) -> str:
        """Return the origin of a row's numbers: its own field, that of its cell's engine, or that of the run."""
        if of_row := getattr(row, PROVENANCE, ""):
            return str(of_row)
        cell = getattr(row, "cell", "")
        if cell not in self._codes:
            self._codes[cell] = Origins.of_manifest(self._manifest).of_row(cell)
        return self._codes[cell]

    def sample(self, row: SampleRow) -> None:
        self.append(self._samples, [row])

    def tokens(self, rows: Iterable[TokenRow]) -> None:
        self.append(TOKENS, rows)

    def frame(self, row: FrameRow) -> None:
        self.append(self._frames, [row])

    def update(self, **facts: Any) -> None:
        """Merge facts into the manifest (mappings key by key) and replace the file."""
        manifests.merge(self._manifest, facts)
        self._codes.clear()
        try:
            manifests.write(self.path, self._manifest)
        except StoreError:
            if not files.release(self.path):
                raise
            manifests.write(self.path, self._manifest)

    def finish(self, state: Ended, error: str | None = None) -> None:
        """Close the files, write the Parquet ones and the final state; a second call does nothing.

        A killed run stays "running"; its rows are whole.
        """
        if self._finished:
            return
        self._finished = True
        for _, file in self._files.values():
            file.close()
        files.release(self.path)
        try:
            for table, file in self._files.values():
                files.write_parquet(self.path / f"{table.name}.parquet", files.read_csv(file.path, table.columns))
        except MissingExtra:
            pass  # the CSV files are complete, and reading them raises it again
        except StoreError as full:
            state, error = "failed", error or str(full)
            raise
        finally:
            # the state is written even if the disk is full, or at a second Ctrl-C
            self.update(state=state, error=error, finished=manifests.utc_now())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        empty = self._created and not (self._rows or self._finished) and str(self.path) not in str(error)
        if error is not None and empty and self._discard():
            return
        ended: Ended = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        why = None if error is None else str(error) or type(error).__name__
        try:
            self.finish("finished" if error is None else ended, why)
        except StoreError:
            if error is None:  # else the first error matters more
                raise

    def _discard(self) -> bool:
        """Remove the folder and the empty ones made for it; return False if it holds a folder."""
        with suppress(OSError):  # the first error matters more
            if any(map(Path.is_dir, self.path.iterdir())):
                return False
            self._finished = True
            for _, file in self._files.values():
                file.close()
            shutil.rmtree(self.path, ignore_errors=True)
            for folder in self._created[1:]:
                folder.rmdir()
        return not self.path.exists()


@dataclass(frozen=True, slots=True)
class StoredRun:
    """One run: the manifest, and its tables as DataFrames, each read at its first use.

    Times are integers (Int64) in ns, `marks` and `facts` JSON text; a missing value is ``pd.NA``. The origin of the
    numbers is ``attrs["provenance"]`` and, row by row, the last column.
    """

    path: Path
    manifest: dict[str, Any]
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """The tables read so far, by name."""

    def table(self, table: Table[Any], columns: Sequence[str] | None = None) -> pd.DataFrame:
        """Return a table with all its columns, empty if the run has none; raises StoreError for a damaged file.

        With ``columns`` it has only these, of which texts but JSON are categoricals in order of appearance; they are
        read alone from the Parquet file of a run that has ended, and not kept.
        """
        if columns is None:
            if table.name not in self.tables:
                self.tables[table.name] = self._read(table.name, table.columns)
            return self.tables[table.name]
        texts = [name for name in columns if table.columns[name] == "string"]
        if table.name not in self.tables and (self.path / f"{table.name}.parquet").exists():
            kinds = {name: table.columns[name] for name in columns} | dict.fromkeys(texts, "category")
            return self._read(table.name, kinds)
        import pandas as pd

        rows = self.table(table)[[*columns]]
        return rows.astype({name: pd.CategoricalDtype([*rows[name].dropna().unique()]) for name in texts})

    def _read(self, name: str, columns: dict[str, Kind]) -> pd.DataFrame:
        """Read columns of a table, from its CSV if the run has not ended."""
        csv = self.path / f"{name}.csv"
        parquet = csv.with_suffix(".parquet")
        whole = parquet.exists()
        rows = files.read_parquet(parquet, columns) if whole else files.to_pandas(files.read_csv(csv, columns))
        rows.attrs[PROVENANCE] = self.origins.line
        return rows

    @property
    def origins(self) -> Origins:
        return Origins.of_manifest(self.manifest)

    @property
    def bootstrap_seed(self) -> int:
        return int(self.manifest.get("seeds", {}).get("bootstrap") or 0)

    def row_counts(self) -> dict[str, int]:
        counts = {name: len(table) for name, table in self.tables.items()}
        by_name = {file.stem: file for kind in ("*.csv", "*.parquet") for file in self.path.glob(kind)}
        for name in sorted(by_name.keys() - counts.keys()):
            counts[name] = files.count_rows(by_name[name])
        return {name: count for name, count in counts.items() if count}

    @property
    def stages(self) -> dict[str, str]:
        """Stage -> group of the run's transports, in the order of the path."""
        return dict(self.manifest.get("stages", {}))

    @property
    def facts(self) -> dict[str, dict[str, str]]:
        return dict(self.manifest.get("facts", {}))

    @property
    def samples(self) -> pd.DataFrame:
        return self.table(samples_table(self.stages))

    @property
    def tokens(self) -> pd.DataFrame:
        return self.table(TOKENS)

    @property
    def frames(self) -> pd.DataFrame:
        return self.table(frames_table(self.stages))


def read_run(path: Path) -> StoredRun:
    """Open a run folder; raises StoreError if it is not one, of another version, or an export that changed."""
    path = Path(path)
    manifest = manifests.read(path)
    export.check(path, manifest)
    return StoredRun(path, manifest)


@contextmanager
def fits(*runs: StoredRun) -> Iterator[None]:
    """Turn an error about missing or wrong data in the block into a StoreError that names the runs."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        paths = ", ".join(str(run.path) for run in runs)
        raise StoreError(f"{paths}: rows and manifest do not fit: {error!r}") from error


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._]+", "-", name).strip("-.") or "unnamed"


def _make_unique(root: Path, stem: str) -> Path:
    """Create a new folder; the second one of the same second gets the suffix -2."""
    root.mkdir(parents=True, exist_ok=True)
    if not os.access(root, os.W_OK | os.X_OK):
        raise PermissionError(13, "permission denied", str(root))
    for number in count(1):
        path = root / (stem if number == 1 else f"{stem}-{number}")
        with suppress(FileExistsError):
            path.mkdir()
            return path
    raise AssertionError  # count() does not end
