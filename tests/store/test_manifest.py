"""Facts on their way into the manifest, and manifests that are too large."""

from __future__ import annotations

from dataclasses import dataclass

from s2a_bench.store import manifest as manifests


def test_what_has_no_value_is_absent_where_its_default_is_none_and_null_where_it_is_not() -> None:
    @dataclass
    class Told:
        always: int | None
        rarely: int | None = None
        flag: bool = False

    assert manifests.present(Told(None)) == {"always": None, "flag": False}
    assert manifests.present(Told(1, 2)) == {"always": 1, "rarely": 2, "flag": False}
