"""Files that users name are read within bounds, and one that is beyond them is one line."""

from __future__ import annotations

from pathlib import Path
from time import process_time

import pyarrow as pa
import pytest
from pyarrow import parquet

from s2a_bench.boards.profile import parse_profile
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


@pytest.mark.parametrize("key", ["a." * 20_000 + "a = 1", "['a'" + " . 'a'" * 6_000 + "]", '"a".' * 10_000 + "a = 1"])
def test_a_key_of_thousands_of_parts_is_refused_before_it_costs_time(key: str) -> None:
    began = process_time()
    with pytest.raises(UsageError, match=r"^profile p: .* dotted key of more than 32 names"):
        parse_profile("p", key, "profile p")
    assert process_time() - began < 10  # it was 22 s


def test_numbers_and_texts_with_dots_are_no_keys() -> None:
    with pytest.raises(UsageError, match="there is no such key"):
        parse_profile("p", f"gap = [{', '.join(['0.1'] * 100)}]\nname = '{'one. ' * 20}'", "profile p")


def test_a_long_word_costs_no_time() -> None:
    began = process_time()
    with pytest.raises(UsageError, match="there is no such key"):
        parse_profile("p", f"hash = '{'a' * 1_000_000}'", "profile p")
    assert process_time() - began < 5  # of a search that begins at every letter: hours


def test_values_are_counted_by_the_footer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "samples.parquet"
    parquet.write_table(pa.table({"n": pa.array([0] * 101)}), path)
    monkeypatch.setattr(files, "VALUES", 201)
    assert len(files.read_parquet(path, {"n": "int64"})) == 101
    monkeypatch.setattr(parquet.ParquetFile, "read", lambda *_: pytest.fail("it was read"))
    with pytest.raises(StoreError, match="has 101 rows of 2 columns; at most 201 values are read"):
        files.read_parquet(path, {"n": "int64", "m": "int64"})
