"""Runs made by hand: durations in ms a stage and cell, the empty name being the residual."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import Run, RunWriter, read_run

Durations: TypeAlias = Mapping[str, float]
MakeRun: TypeAlias = Callable[..., Run]

PLAUSIBLE: dict[str, Durations] = {
    "http/as-deployed": {
        "capture": 0.09,
        "convert": 0.15,
        "image_encode": 1.9,
        "base64_encode": 0.25,
        "json_pack": 0.5,
        "": 0.04,
        "network": 0.9,
        "json_parse": 0.8,
        "base64_decode": 0.3,
        "image_decode": 1.6,
        "inference": 0.01,
        "return": 0.8,
    },
    "http/best-effort": {
        "capture": 0.09,
        "convert": 0.15,
        "image_encode": 1.9,
        "base64_encode": 0.03,
        "json_pack": 0.05,
        "": 0.03,
        "network": 0.5,
        "json_parse": 0.05,
        "base64_decode": 0.03,
        "image_decode": 1.6,
        "inference": 0.01,
        "return": 0.4,
    },
    "http/binary": {
        "capture": 0.09,
        "convert": 0.15,
        "image_encode": 1.9,
        "": 0.03,
        "network": 0.5,
        "image_decode": 1.6,
        "inference": 0.01,
        "return": 0.4,
    },
    "ros/topic": {
        "capture": 0.09,
        "convert": 0.15,
        "cdr_pack": 0.12,
        "": 0.02,
        "network": 0.7,
        "cdr_parse": 0.03,
        "channel_swap": 0.06,
        "inference": 0.01,
        "return": 0.2,
    },
    "loopback": {
        "capture": 0.09,
        "convert": 0.15,
        "": 0.003,
        "channel_swap": 0.06,
        "inference": 0.01,
        "return": 0.005,
    },
}
BLACK_BOX: Durations = {"capture": 0.1, "image_encode": 2.0, "json_pack": 0.4, "server": 300.0, "return": 0.0}


def marks_of(durations: Durations, start_ns: int, factor: float = 1.0) -> list[tuple[str, int]]:
    marks = [("", start_ns)]
    for stage, duration in durations.items():
        marks.append((stage, marks[-1][1] + round(duration * factor * 1e6)))
    return marks


def row_of(cell: str, durations: Durations, block: int, **facts: Any) -> SampleRow:
    pipeline, _, variant = cell.partition("/")
    payload = {"http": "jpeg", "ros": "bgr"}.get(pipeline, "none")
    whole: dict[str, Any] = {
        "cell": cell,
        "pipeline": pipeline,
        "variant": variant,
        "payload": payload,
        "connection": "keep-alive",
        "engine": "echo",
        "mode": "request",
        "size": "640x480",
        "block": block,
        "position": 0,
        "warmup": False,
        "request_id": f"{cell}-{block}",
        "frame_index": block,
        "marks": marks_of(durations, 10**9),
    }
    return SampleRow(**whole | facts)


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Make a run of lognormal durations (``spread`` > 0) or exact ones (``spread`` = 0)."""

    def make(
        cells: Mapping[str, Durations] = PLAUSIBLE,
        *,
        n: int = 50,
        spread: float = 0.15,
        n_tokens: int = 3,
        manifest: Mapping[str, Any] | None = None,
        extra: tuple[SampleRow, ...] = (),
        payloads: Mapping[str, str] | None = None,
        **facts: Any,
    ) -> Run:
        rng = np.random.default_rng(1)
        with RunWriter.create(tmp_path, "latency", dict(manifest or {})) as run:
            for block in range(-5, n):
                load = rng.lognormal(0, spread)
                for cell, durations in cells.items():
                    marks = marks_of(durations, 10**9, load * rng.lognormal(0, spread))
                    row = row_of(cell, durations, block, marks=marks, warmup=block < 0, n_tokens=n_tokens, **facts)
                    row = replace(row, payload=(payloads or {}).get(row.pipeline, row.payload))
                    run.sample(row)
                    run.tokens(
                        TokenRow(row.request_id, cell, i, i, "x", None, marks[-1][1] + i * 2_000_000)
                        for i in range(n_tokens)
                    )
            for row in extra:
                run.sample(row)
        return read_run(run.path)

    return make


@pytest.fixture
def plausible() -> dict[str, Durations]:
    return dict(PLAUSIBLE)


@pytest.fixture
def black_box() -> Durations:
    return BLACK_BOX


@pytest.fixture
def make_row() -> Callable[..., SampleRow]:
    return row_of
