"""Files that cannot be written or read."""

from __future__ import annotations

from pathlib import Path

import pytest
from pyarrow import parquet

from s2a_bench.errors import StoreError
from s2a_bench.store.files import CsvFile, write_parquet


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
