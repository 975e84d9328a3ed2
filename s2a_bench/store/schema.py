"""The rows of a run folder and their columns, generated from the dataclasses below and from `trace.STAGES`.

A row's own fields are what was observed; *derived* columns are computed from its chain of marks by
`trace.budget`, never typed a second time. A stage that the chain does not have is null, never zero; where the
request failed every derived column is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from types import NoneType
from typing import Any, Final, Generic, Literal, TypeAlias, TypeVar, get_args, get_type_hints

from s2a_bench.trace import STAGES, Budget, Mark, budget

SCHEMA: Final = "s2a-bench/1"
"""The version of folder, columns and ``--json``; it changes when a column changes its meaning or goes."""

Kind: TypeAlias = Literal["string", "int64", "float64", "bool"]
"""What a column holds, by its Arrow name."""

Value: TypeAlias = str | int | float | bool | None
"""One field as stored; None is null."""


@dataclass(frozen=True, slots=True)
class SampleRow:
    """One request: which cell, where in the run, its whole chain of marks, and what is known besides.

    ``cell`` is what is compared, e.g. ``http/as-deployed``. ``payload`` is what travels: jpeg, jpeg-preencoded, png
    or raw over HTTP; bgr, yuyv or compressed over ROS; none for loopback. An empty ``error`` means that the
    request succeeded. ``frame_age_ns`` is the frame's age when inference starts.
    """

    cell: str
    pipeline: str
    variant: str
    payload: str
    connection: str
    engine: str
    mode: str
    size: str
    block: int
    position: int
    warmup: bool
    request_id: str
    frame_index: int
    error: str = ""
    marks: list[Mark] = field(default_factory=list)
    payload_bytes: int | None = None
    n_tokens: int = 0
    last_token_ns: int | None = None
    frame_age_ns: int | None = None
    cache_n: int | None = None
    prompt_n: int | None = None
    server_prompt_ms: float | None = None
    facts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TokenRow:
    """One token: when it left the engine (null where the server is a black box) and when the client saw it."""

    request_id: str
    cell: str
    index: int
    token_id: int
    text: str
    engine_ns: int | None
    client_ns: int


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame of a stream-mode run; ``used_by`` is the request that looked at it, or empty."""

    cell: str
    frame_index: int
    intended_ns: int
    marks: list[Mark] = field(default_factory=list)
    used_by: str = ""


Row = TypeVar("Row")
"""The dataclass of a table's rows."""


@dataclass(frozen=True, slots=True)
class Table(Generic[Row]):
    """One file of a run folder: its rows' type, its columns in order, and how a row becomes values."""

    name: str
    columns: dict[str, Kind]
    derive: Callable[[Row], dict[str, Value]]

    def values(self, row: Row) -> Iterator[Value]:
        """Yield one value a column, the row's own fields first; lists and dicts become JSON text."""
        for item in fields(row):  # type: ignore[arg-type]  # a row is a dataclass
            yield _stored(getattr(row, item.name))
        derived = self.derive(row)
        for name in list(self.columns)[len(fields(row)) :]:  # type: ignore[arg-type]
            yield _stored(derived.get(name))


def _stored(value: Any) -> Value:
    """Turn a field into what the files hold; a float that is no number is null."""
    if isinstance(value, dict):
        value = {name: _stored(fact) for name, fact in value.items()}
    if isinstance(value, (list, dict)):
        return json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value  # type: ignore[no-any-return]


def _kind(hint: Any) -> Kind:
    """Name the column type of an annotation; whatever is no plain number travels as text."""
    plain = next((arg for arg in get_args(hint) if arg is not NoneType), hint) if NoneType in get_args(hint) else hint
    kinds: dict[Any, Kind] = {int: "int64", float: "float64", bool: "bool"}
    return kinds.get(plain, "string")


def _columns(row: type, derived: dict[str, Kind]) -> dict[str, Kind]:
    """List a table's columns: the row's fields, then the derived ones."""
    hints = get_type_hints(row)
    return {item.name: _kind(hints[item.name]) for item in fields(row)} | derived


def _stage_values(spent: Budget) -> dict[str, Value]:
    """Name each duration of a budget by its column."""
    return {f"{stage}_ns": duration for stage, duration in spent.stages_ns.items()}


FIRST_TOKEN: Final = frozenset({"return", "ingest", "server"})
"""A chain with one of these stages ends when the client sees the first token; the last two stand for black boxes."""


def _derive_sample(row: SampleRow) -> dict[str, Value]:
    """Compute a sample's durations; a chain that does not reach the first token has no end to end."""
    if row.error or not any(stage in FIRST_TOKEN for stage, _ in row.marks):
        return {}
    spent = budget(row.marks)
    return {
        **_stage_values(spent),
        "e2e_ns": spent.e2e_ns,
        "e2e_without_inference_ns": spent.e2e_without_inference_ns,
        "ttft_ns": spent.e2e_ns - spent.stages_ns.get("capture", 0),
        "residual_ns": spent.residual_ns,
        "residual_share": spent.residual_share,
    }


def _derive_frame(row: FrameRow) -> dict[str, Value]:
    """Compute a frame's durations up to its last mark, from capture and from the time it was due."""
    if not row.marks:
        return {}
    spent = budget(row.marks)
    return {
        **_stage_values(spent),
        "path_ns": spent.e2e_ns,
        "latency_ns": row.marks[-1][1] - row.intended_ns,
        "residual_ns": spent.residual_ns,
    }


_STAGE_COLUMNS: dict[str, Kind] = {f"{stage}_ns": "int64" for stage in STAGES}

SAMPLES: Final[Table[SampleRow]] = Table(
    "samples",
    _columns(
        SampleRow,
        _STAGE_COLUMNS
        | {
            "e2e_ns": "int64",
            "e2e_without_inference_ns": "int64",
            "ttft_ns": "int64",
            "residual_ns": "int64",
            "residual_share": "float64",
        },
    ),
    _derive_sample,
)
"""One row a request. `ttft_ns` counts from the prompt: e2e without `capture` (which stream mode does not have)."""

TOKENS: Final[Table[TokenRow]] = Table("tokens", _columns(TokenRow, {}), lambda _row: {})
"""One row a token."""

FRAMES: Final[Table[FrameRow]] = Table(
    "frames",
    _columns(FrameRow, _STAGE_COLUMNS | {"path_ns": "int64", "latency_ns": "int64", "residual_ns": "int64"}),
    _derive_frame,
)
"""One row a frame in stream mode. `latency_ns` counts from the intended time (no coordinated omission)."""

TABLES: Final[dict[str, Table[Any]]] = {table.name: table for table in (SAMPLES, TOKENS, FRAMES)}
"""Every table a run folder may hold, by its file's name."""
