"""Files that cannot be written, errors of a full disk, and facts on their way into the manifest."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa
import pytest
from pyarrow import parquet

from s2a_bench.errors import StoreError
from s2a_bench.store import files
from s2a_bench.store.files import CsvFile, why, write_parquet
from s2a_bench.store.manifest import present


def test_parquet_that_cannot_be_written_says_so_in_the_system_s_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_table: object, path: Path) -> None:
        path.write_bytes(b"PAR1")
        raise OSError("Arrow's own words")

    monkeypatch.setattr(parquet, "write_table", refuse)
    with pytest.raises(StoreError, match=r"x\.parquet: Input/output error; the CSV files are complete"):
        write_parquet(tmp_path / "x.parquet", None)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_there_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("mine")
    with pytest.raises(StoreError, match=r"cannot create .*x\.csv: File exists; choose another `output`"):
        CsvFile(tmp_path / "x.csv", ["a"])
    assert (tmp_path / "x.csv").read_text() == "mine"


def test_values_are_counted_by_the_footer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "samples.parquet"
    parquet.write_table(pa.table({"n": pa.array([0] * 101)}), path)
    monkeypatch.setattr(files, "VALUES", 201)
    assert len(files.read_parquet(path, {"n": "int64"})) == 101
    monkeypatch.setattr(parquet.ParquetFile, "read", lambda *_: pytest.fail("it was read"))
    with pytest.raises(StoreError, match="has 101 rows of 2 columns; at most 201 values are read"):
        files.read_parquet(path, {"n": "int64", "m": "int64"})


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_where_there_is_no_room_the_file_system_and_what_is_free_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(os.path, "ismount", lambda path: path == tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=12_345 if path == tmp_path else 0))
    full = OSError(number, os.strerror(number))
    text = f"{full.strerror} (file system {tmp_path}, 12,345 bytes free; free some space, or choose another `output`)"
    assert why(full, tmp_path / "a" / "b.csv") == text
    monkeypatch.setattr(shutil, "disk_usage", lambda _: (_ for _ in ()).throw(OSError()))
    assert why(full, tmp_path) == text.replace(", 12,345 bytes free", "")
    assert why(OSError(errno.EIO, "broken"), tmp_path) == "broken"
    assert why(OSError("own words"), tmp_path) == "own words"


def test_what_has_no_value_is_absent_where_its_default_is_none_and_null_where_it_is_not() -> None:
    @dataclass
    class Told:
        always: int | None
        rarely: int | None = None
        flag: bool = False

    assert present(Told(None)) == {"always": None, "flag": False}
    assert present(Told(1, 2)) == {"always": 1, "rarely": 2, "flag": False}
