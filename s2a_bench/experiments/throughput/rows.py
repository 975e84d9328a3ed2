"""The rows of the reference program of a throughput run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class ReferenceRow:
    """One run of llama-bench beside ours: ``n_gen`` tokens decoded in ``decode_ns``, behind ``depth`` others."""

    block: int
    position: int
    warmup: bool
    started_ns: int
    finished_ns: int
    n_gen: int
    depth: int
    decode_ns: int
    facts: dict[str, Any] = field(default_factory=dict)
    launch: int = 0


REFERENCE: Final[Table[ReferenceRow]] = Table("reference", ReferenceRow)
"""One row a run of the reference program."""
