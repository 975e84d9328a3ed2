"""Runs made by hand: durations in ms a stage and cell, the empty name being the residual."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from s2a_bench.boards.profile import to_toml
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.requests import SampleRow, TokenRow
from s2a_bench.store.run import RunWriter, StoredRun, read_run

Durations: TypeAlias = Mapping[str, float]
MakeRun: TypeAlias = Callable[..., StoredRun]

SCHEMA: Any = json.loads((Path(__file__).parents[1] / "docs" / "schema" / "s2a-bench-1.json").read_text())
"""What --json prints."""
STAGES = {
    "capture": "capture",
    "convert": "encode",
    "image_encode": "encode",
    "base64_encode": "encode",
    "json_pack": "pack",
    "cdr_pack": "pack",
    "connect": "network",
    "network": "network",
    "accept": "network",
    "ingest": "ingest",
    "json_parse": "parse",
    "cdr_parse": "parse",
    "base64_decode": "decode",
    "image_decode": "decode",
    "yuv_decode": "decode",
    "channel_swap": "decode",
    "queue": "queue",
    "inference": "inference",
    "server": "server",
    "return": "return",
}
"""Stage -> group of the runs made here, where a test does not say."""


def known(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return a manifest with the stages and the provenance that a run writes, where it has none."""
    origins = Origins(Provenance.of_engine(manifest.get("model") or {}, link="real"))
    return {"stages": STAGES, "provenance": origins.to_manifest(), **manifest}


HEAD, *ROWS = """
stage          http/as-deployed  http/best-effort  http/binary  ros/topic  loopback
capture        0.09              0.09              0.09         0.09       0.09
convert        0.15              0.15              0.15         0.15       0.15
image_encode   1.9               1.9               1.9          -          -
base64_encode  0.25              0.03              -            -          -
json_pack      0.5               0.05              -            -          -
cdr_pack       -                 -                 -            0.12       -
residual       0.04              0.03              0.03         0.02       0.003
network        0.9               0.5               0.5          0.7        -
json_parse     0.8               0.05              -            -          -
cdr_parse      -                 -                 -            0.03       -
base64_decode  0.3               0.03              -            -          -
image_decode   1.6               1.6               1.6          -          -
channel_swap   -                 -                 -            0.06       0.06
inference      0.01              0.01              0.01         0.01       0.01
return         0.8               0.4               0.4          0.2        0.005
""".strip().splitlines()
PLAUSIBLE: dict[str, Durations] = {
    cell: {row[0].replace("residual", ""): float(row[at]) for row in map(str.split, ROWS) if row[at] != "-"}
    for at, cell in enumerate(HEAD.split()[1:], 1)
}
"""Durations in ms, as a machine might have them."""
BLACK_BOX: Durations = {"capture": 0.1, "image_encode": 2.0, "json_pack": 0.4, "server": 300.0, "return": 0.0}


def marks_of(durations: Durations, start_ns: int, factor: float = 1.0) -> list[tuple[str, int]]:
    marks = [("", start_ns)]
    for stage, duration in durations.items():
        marks.append((stage, marks[-1][1] + round(duration * factor * 1e6)))
    return marks


def row_of(cell: str, durations: Durations, block: int, **facts: Any) -> SampleRow:
    path, _, named = cell.partition("?payload=")
    pipeline, _, variant = path.partition("/")
    payload = named or {"http": "raw", "ros": "raw"}.get(pipeline, "none")
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


def made_run(
    folder: Path,
    cells: Mapping[str, Durations] = PLAUSIBLE,
    *,
    n: int = 50,
    launches: int = 1,
    spread: float = 0.15,
    n_tokens: int = 3,
    manifest: Mapping[str, Any] | None = None,
    extra: tuple[SampleRow, ...] = (),
    payloads: Mapping[str, str] | None = None,
    **facts: Any,
) -> StoredRun:
    """Make a run of lognormal durations (``spread`` > 0) or exact ones (``spread`` = 0), ``n`` over all launches."""
    rng = np.random.default_rng(1)
    with RunWriter.create(folder, "latency", known(manifest or {})) as run:
        for block in range(-5, n):
            load = rng.lognormal(0, spread)
            for cell, durations in cells.items():
                marks = marks_of(durations, 10**9, load * rng.lognormal(0, spread))
                place = {"warmup": block < 0, "launch": max(block, 0) * launches // n}
                row = row_of(cell, durations, block, marks=marks, n_tokens=n_tokens, **place, **facts)
                row = replace(row, payload=(payloads or {}).get(row.pipeline, row.payload))
                run.sample(row)
                run.tokens(
                    TokenRow(row.request_id, cell, i, i, "x", None, marks[-1][1] + i * 2_000_000)
                    for i in range(n_tokens)
                )
        for row in extra:
            run.sample(row)
    return read_run(run.path)


def spoken_run(folder: Path, rate: float, *, engine: str = "llama", **manifest: Any) -> StoredRun:
    """Make a throughput run whose engine generates at a rate."""
    durations = {"convert": 10, "inference": 5, "return": 0}
    with RunWriter.create(folder, "throughput", manifest) as run:
        for block in range(10):
            facts = {"predicted_n": 48.0, "predicted_ms": 48e3 / rate}
            row = row_of("in-process", durations, block, engine=engine, facts=facts, n_tokens=2)
            run.sample(replace(row, pipeline="loopback"))
            run.tokens(TokenRow(row.request_id, row.cell, i, i, "x", None, 10**10 + i * 10**7) for i in range(2))
    return read_run(run.path)


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    return partial(made_run, tmp_path)


@pytest.fixture
def fast_board(tmp_path: Path) -> str:
    """The profile of a board of 120 tokens a second."""
    facts = {"title": "A board", "origin": "measured", "tokens_per_s": 120.0, "prompt_s": 0.05}
    path = tmp_path / "fast.toml"
    path.write_text(to_toml({**facts, "gaps": {"family": "constant"}}))
    return str(path)


@pytest.fixture
def plausible() -> dict[str, Durations]:
    return dict(PLAUSIBLE)


@pytest.fixture
def black_box() -> Durations:
    return BLACK_BOX


@pytest.fixture
def make_row() -> Callable[..., SampleRow]:
    return row_of
