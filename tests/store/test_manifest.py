"""Facts on their way into the manifest, and manifests that are too large."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from s2a_bench.errors import StoreError
from s2a_bench.store import manifest as manifests
from s2a_bench.store.run import read_run


def test_what_has_no_value_is_absent_where_its_default_is_none_and_null_where_it_is_not() -> None:
    @dataclass
    class Told:
        always: int | None
        rarely: int | None = None
        flag: bool = False

    assert manifests.present(Told(None)) == {"always": None, "flag": False}
    assert manifests.present(Told(1, 2)) == {"always": 1, "rarely": 2, "flag": False}


def test_a_manifest_of_more_than_64_mib_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "manifest.json"
    with path.open("wb") as file:
        file.truncate((64 << 20) + 1)
    with pytest.raises(StoreError, match=r"manifest\.json is damaged: it is larger than 64 MiB"):
        read_run(tmp_path)
    path.write_text('{"schema": "s2a-bench/1", "command": "latency", "state": "finished"}')
    monkeypatch.setattr(manifests, "MAX_BYTES", path.stat().st_size)
    assert read_run(tmp_path).manifest["command"] == "latency"
    monkeypatch.setattr(manifests, "MAX_BYTES", path.stat().st_size - 1)
    with pytest.raises(StoreError, match="larger"):
        read_run(tmp_path)
