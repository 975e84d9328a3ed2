"""A row of a run of chunks as ``--json`` and its schema hold it."""

from __future__ import annotations

from typing import Annotated

from s2a_bench.experiments.chunks.rows import ChunkRow
from s2a_bench.store.bounds import about
from s2a_bench.writers.as_json import cell_of_row

ChunkCell = cell_of_row(
    "ChunkCell",
    "A mode of acting on chunks under one source of latencies.",
    ChunkRow,
    without=(),
    own={
        "emulated": Annotated[bool, about("Whether latencies were given or drawn, in virtual time or by the server.")]
    },
)
