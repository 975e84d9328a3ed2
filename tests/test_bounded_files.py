"""Files that users name are read within bounds, and one that is beyond them is one line."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet

from s2a_bench.errors import StoreError, UsageError
from s2a_bench.store import files
from s2a_bench.sweep.file import read_sweep_file
from s2a_bench.text import read_text


def test_a_file_without_end_is_one_line() -> None:
    with pytest.raises(UsageError, match=r"`file`: cannot read /dev/zero: .* longer than 8388608 letters"):
        read_sweep_file(Path("/dev/zero"))


def test_line_ends_are_as_python_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes("ä\r\nb".encode())
    assert read_text(path) == "ä\nb"


def test_values_are_counted_by_the_footer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "samples.parquet"
    parquet.write_table(pa.table({"n": pa.array([0] * 101)}), path)
    monkeypatch.setattr(files, "VALUES", 201)
    assert len(files.read_parquet(path, {"n": "int64"})) == 101
    monkeypatch.setattr(parquet.ParquetFile, "read", lambda *_: pytest.fail("it was read"))
    with pytest.raises(StoreError, match="has 101 rows of 2 columns; at most 201 values are read"):
        files.read_parquet(path, {"n": "int64", "m": "int64"})
