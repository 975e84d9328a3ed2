"""Text files that users name."""

from __future__ import annotations

from pathlib import Path

import pytest

from s2a_bench.errors import UsageError
from s2a_bench.sweep.file import read_sweep_file
from s2a_bench.text import read_text
from s2a_bench.toml_file import loads


def test_a_file_without_end_is_one_line() -> None:
    with pytest.raises(UsageError, match=r"`file`: cannot read /dev/zero: .* longer than 8388608 letters"):
        read_sweep_file(Path("/dev/zero"))


def test_line_ends_are_as_python_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes("ä\r\nb".encode())
    assert read_text(path) == "ä\nb"


def test_a_key_of_thousands_of_parts_is_one_line() -> None:
    with pytest.raises(UsageError, match="a dotted key of more than 32 names"):
        loads(".".join(["a"] * 20_000) + " = 1", "a file")
