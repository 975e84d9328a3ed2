"""Throughput runs, and latency runs of two sides, made by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import Run, RunWriter, read_run

MakeRun = Callable[..., Run]
MakeRow = Callable[..., SampleRow]
DURATIONS = {"convert": 10, "inference": 5, "return": 0}
REAL = Provenance("llama", "MiniCPM-V 2.6", "ab", "Q4_K_M", "real", "measured")


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
    ) -> Run:
        whole = {
            "configuration": {"pipelines": {name: {} for name in cells} | dict(options or {})},
            "provenance": Origins(REAL, dict(origins or {})).to_manifest(),
            **(manifest or {}),
        }
        travels = {"http": "jpeg-preencoded", "ros": "raw"} | dict(payloads or {})
        return make_run(cells, launches=launches, payloads=travels, manifest=whole, **facts)

    return made


@pytest.fixture
def spoken(tmp_path: Path, make_row: MakeRow) -> MakeRun:
    """Make a throughput run whose engine generates at a rate."""

    def made(rate: float, *, engine: str = "llama", **manifest: Any) -> Run:
        with RunWriter.create(tmp_path, "throughput", manifest) as run:
            for block in range(10):
                facts = {"predicted_n": 48.0, "predicted_ms": 48e3 / rate}
                row = make_row("in-process", DURATIONS, block, engine=engine, facts=facts, n_tokens=2)
                run.sample(replace(row, pipeline="loopback"))
                run.tokens(TokenRow(row.request_id, row.cell, i, i, "x", None, 10**10 + i * 10**7) for i in range(2))
        return read_run(run.path)

    return made
