r"""Tables on disk: a CSV that grows by whole records, the Parquet file made from it, and errors of a full disk.

A record is written in one system call, so a killed process loses at most the last record. A record ends at a line feed
with an even number of quotation marks before it (RFC 4180, with ``\n``); anything after the last such line feed is
torn and is dropped when read. An empty field is null, in text columns the empty text.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from errno import EDQUOT, EIO, ENOSPC
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.errors import MissingExtra, StoreError
from s2a_bench.store.schema import Kind, Row, Table, Value

if TYPE_CHECKING:
    import pandas as pd

RESERVE: Final = ".reserve"
RESERVE_BYTES: Final = 256 * 1024
"""Reserved in a run folder while it is written, so that a run that fills its disk can still write its manifest."""


class CsvFile:
    """One table's CSV, open for appending."""

    def __init__(self, path: Path, columns: Iterable[str], *, reopen: bool = False) -> None:
        """Create the file, which must not exist, with its header; ``reopen`` appends to its whole records."""
        self.path = path
        try:
            self._file = path.open("r+b" if reopen else "xb", buffering=0)
        except OSError as error:
            raise StoreError(f"cannot create {path}: {why(error, path)}; choose another `output`") from error
        self._end = len(whole_records(self._file.read())) if reopen else 0
        self._file.truncate(self._end)
        self._file.seek(self._end)
        if not self._end:
            self._write(",".join(columns) + "\n")

    def append(self, table: Table[Row], rows: Iterable[Row], provenance: Callable[[Row], str]) -> None:
        """Write rows in one system call, each with its ``provenance``."""
        self._write("".join(record(table.values(row, provenance(row))) for row in rows))

    def close(self) -> None:
        self._file.close()

    def _write(self, text: str) -> None:
        """Append the text as a whole or not at all."""
        data = text.encode("utf-8", "backslashreplace")  # a model may yield half a character
        try:
            written = self._file.write(data)
            while written < len(data):  # the next write succeeds, or raises the reason: the disk is full
                written += self._file.write(data[written:])
        except OSError as error:
            self._file.truncate(self._end)
            self._file.seek(self._end)
            raise StoreError(f"cannot write {self.path}: {why(error, self.path)}; samples so far are kept") from error
        self._end += len(data)


def record(values: Iterable[Value]) -> str:
    """Return a record of a CSV file."""
    return ",".join(map(_field, values)) + "\n"


def _field(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    text = str(value).replace('"', '""')
    return f'"{text}"' if any(mark in text for mark in ',"\r\n') else text


VALUES: Final = 500_000_000
"""Limit on the values (rows times columns) read of a Parquet file: a few bytes can encode any number of equal ones."""


def _arrow(path: Path) -> tuple[Any, Any, Any]:
    """Return pyarrow, its CSV and its Parquet module; raises MissingExtra if it does not load beside this NumPy."""
    try:
        import pyarrow as pa
        from pyarrow import csv, parquet
    except (ImportError, AttributeError, RuntimeError) as error:
        reason = "".join(str(error).strip().splitlines()[:1]) or type(error).__name__
        raise MissingExtra(
            f"pyarrow does not load beside NumPy {version('numpy')} ({reason}): the CSV files in {path.parent} are "
            "complete and all else can be made from them; beside NumPy 1, which ROS needs, "
            "pip install -c constraints-ros-jazzy.txt pyarrow"
        ) from error
    return pa, csv, parquet


def count_rows(path: Path) -> int:
    """Return the number of rows of a Parquet or CSV file without reading their values; raises StoreError."""
    if path.suffix == ".parquet":
        pa, _, parquet = _arrow(path)
        with _undamaged(path, pa):
            return int(parquet.read_metadata(path).num_rows)
    ends = quotes = 0
    with path.open("rb") as file:
        for line in file:
            quotes += line.count(b'"')
            ends += quotes % 2 == 0 and line.endswith(b"\n")
    return max(ends - 1, 0)


def whole_records(data: bytes) -> bytes:
    """Return the data up to the end of its last whole record."""
    end = data.rfind(b"\n") + 1
    quotes = data.count(b'"', 0, end)
    while quotes % 2:
        before = data.rfind(b"\n", 0, end - 1) + 1
        quotes -= data.count(b'"', before, end)
        end = before
    return data[:end]


def read_csv(path: Path, columns: dict[str, Kind]) -> Any:
    """Read a CSV as a ``pyarrow.Table``, without its torn end; an absent file is an empty table.

    An absent column is null: schema 1 may gain columns.
    """
    pa, csv, _ = _arrow(path)
    schema = _schema(pa, columns)
    data = whole_records(path.read_bytes()) if path.exists() else b""
    if not data:
        return schema.empty_table()
    try:
        return csv.read_csv(
            pa.BufferReader(data),
            # one block, as a quoted line feed may be anywhere
            read_options=csv.ReadOptions(use_threads=False, block_size=len(data) + 1),
            # an empty line is a row of one column that is empty
            parse_options=csv.ParseOptions(newlines_in_values=True, ignore_empty_lines=False),
            convert_options=csv.ConvertOptions(
                column_types=schema,
                include_columns=list(columns),
                include_missing_columns=True,
                null_values=[""],
                strings_can_be_null=False,
                true_values=["true"],
                false_values=["false"],
            ),
        )
    except (pa.ArrowInvalid, pa.ArrowKeyError) as error:
        raise StoreError(f"{path} is damaged: {str(error).splitlines()[0]}") from error


def write_parquet(path: Path, table: Any) -> None:
    """Write a ``pyarrow.Table``; the file appears whole or not at all."""
    _, _, parquet = _arrow(path)
    part = path.with_suffix(".part")
    try:
        parquet.write_table(table, part)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        whole = OSError(error.errno or EIO, os.strerror(error.errno or EIO))  # without the text of Arrow
        raise StoreError(f"cannot write {path}: {why(whole, path)}; the CSV files are complete") from error


def read_parquet(path: Path, columns: dict[str, Kind]) -> pd.DataFrame:
    """Read these columns of a Parquet file as `read_csv` does; raises StoreError for a damaged one.

    They are read one by one, so that no second copy of the whole is held.
    """
    import pandas as pd

    pa, _, parquet = _arrow(path)
    schema = _schema(pa, columns)
    categories = [name for name, kind in columns.items() if kind == "category"]
    with _undamaged(path, pa), parquet.ParquetFile(path, read_dictionary=categories) as file:
        rows = _bounded(path, file.metadata.num_rows, len(columns))

        def read(column: Any) -> pd.DataFrame:
            table = file.read([column.name])
            if not table.column_names:  # schema 1 may gain columns
                table = pa.table([pa.nulls(rows)], [column.name])
            table = table.cast(pa.schema([column]))
            return to_pandas(table)

        return pd.concat(map(read, schema), axis=1)


def _bounded(path: Path, rows: int, columns: int) -> int:
    """Return the number of rows; raises StoreError for too many values."""
    if rows * columns > VALUES:
        raise StoreError(
            f"{path} has {rows} rows of {columns} columns; at most {VALUES} values are read; remove it to read the CSV"
        )
    return rows


def read_texts(path: Path) -> Any:
    """Return all columns of a Parquet or CSV file as texts, in a ``pyarrow.Table``; raises StoreError."""
    pa, _, parquet = _arrow(path)
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", errors="replace") as file:
            return read_csv(path, dict.fromkeys(file.readline().strip().split(","), "string"))
    with _undamaged(path, pa), parquet.ParquetFile(path) as stored:
        names = stored.schema_arrow.names
        _bounded(path, stored.metadata.num_rows, len(names))
        return stored.read().cast(pa.schema([(name, pa.string()) for name in names]))


@contextmanager
def _undamaged(path: Path, pa: Any) -> Iterator[None]:
    """Turn an error of reading a Parquet file into one that names a way out."""
    try:
        yield
    except (OSError, pa.ArrowException, ValueError) as error:
        raise StoreError(f"{path} is damaged: {str(error).splitlines()[0]}; remove it to read the CSV") from error


def to_pandas(table: Any) -> pd.DataFrame:
    """Convert a ``pyarrow.Table`` to a DataFrame with nullable types: integers stay integers, nulls stay nulls.

    The table is used up, and its memory given back to the system.
    """
    import pandas as pd
    import pyarrow as pa

    dtypes = {pa.int64(): pd.Int64Dtype(), pa.float64(): pd.Float64Dtype(), pa.string(): pd.StringDtype()}
    frame: pd.DataFrame = table.to_pandas(types_mapper=dtypes.get, split_blocks=True, self_destruct=True)
    pa.default_memory_pool().release_unused()
    return frame


def _schema(pa: Any, columns: dict[str, Kind]) -> Any:
    types = {
        "string": pa.string(),
        "json": pa.string(),
        "category": pa.dictionary(pa.int32(), pa.string()),
        "int64": pa.int64(),
        "float64": pa.float64(),
        "bool": pa.bool_(),
    }
    return pa.schema([(name, types[kind]) for name, kind in columns.items()])


def why(error: OSError, path: Path) -> str:
    """Return the reason why a path cannot be written; of a full disk also the file system and the free bytes."""
    reason = error.strerror or str(error)
    if error.errno not in {ENOSPC, EDQUOT}:
        return reason
    mount = next(place for place in (path.resolve(), *path.resolve().parents) if os.path.ismount(place))
    try:
        free = f", {shutil.disk_usage(mount).free:,} bytes free"
    except OSError:
        free = ""
    return f"{reason} (file system {mount}{free}; free some space, or choose another `output`)"


def reserve(folder: Path) -> None:
    """Reserve space in a folder; raises OSError on a full file system, before anything is measured."""
    with (folder / RESERVE).open("wb") as file:
        file.write(bytes(RESERVE_BYTES))  # written, as some file systems allocate more than they have


def release(folder: Path) -> bool:
    """Free the reserved space; return False if there was none."""
    try:
        (folder / RESERVE).unlink()
    except FileNotFoundError:
        return False
    return True
