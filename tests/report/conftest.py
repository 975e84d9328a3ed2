"""Throughput runs, and latency runs of two sides, made by hand."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import StoredRun
from tests.made_runs import MakeRun, spoken_run

REAL = Provenance("llama", "MiniCPM-V 2.6", "ab", "Q4_K_M", "real", "measured", link="real")


@pytest.fixture
def beside(make_run: MakeRun) -> MakeRun:
    """Make a latency run that compares like with like: one engine, servers of the run, three launches."""

    def made(
        cells: Mapping[str, Mapping[str, float]],
        *,
        launches: int = 3,
        payloads: Mapping[str, str] | None = None,
        options: Mapping[str, Mapping[str, str]] | None = None,
        origins: Mapping[str, Provenance] | None = None,
        manifest: Mapping[str, Any] | None = None,
        **facts: Any,
    ) -> StoredRun:
        whole = {
            "configuration": {"pipelines": {name: {} for name in cells} | dict(options or {})},
            "provenance": Origins(REAL, dict(origins or {})).to_manifest(),
            **(manifest or {}),
        }
        travels = {"http": "jpeg-preencoded", "ros": "raw"} | dict(payloads or {})
        return make_run(cells, launches=launches, payloads=travels, manifest=whole, **facts)

    return made


@pytest.fixture
def spoken(tmp_path: Path) -> MakeRun:
    return partial(spoken_run, tmp_path)
