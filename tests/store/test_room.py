"""Errors of a full disk name the way out."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from s2a_bench.store.files import why


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
