"""The rows of requests: samples, tokens, the frames of a stream, and the skills of plans.

The fields of a row are observed; *derived* columns are computed from its chain of marks by `trace.budget`. A stage that
the chain does not have is null, never zero; every derived column of a failed request is null.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from s2a_bench.store.schema import Kind, Table, Value
from s2a_bench.trace import Budget, Mark, budget


@dataclass(frozen=True, slots=True)
class SampleRow:
    """One request: its cell, its place in the run, its chain of marks, and more facts.

    ``cell`` is the unit of comparison, e.g. ``http/as-deployed``. ``payload`` is raw, yuyv, jpeg, jpeg-preencoded or
    png, empty for loopback. An empty ``error`` means success. ``frame_age_ns`` is the age of the frame when inference
    starts. ``rgb_source`` is a checksum of the RGB from a reference conversion of the source frame, ``rgb_engine`` of
    the RGB at the engine; null if unknown, as behind a black box. ``launch`` counts the sets of servers from 0,
    ``block`` counts over all launches. Behind a server on another host its marks are where the middle of the offset's
    interval puts them, and may all be off by ``clock_error_ns`` either way; null on one host. What begins on one clock
    and ends on the other is then null, and has its least and greatest value in columns with ``_lo`` and ``_hi``.
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
    rgb_source: int | None = None
    rgb_engine: int | None = None
    facts: dict[str, float] = field(default_factory=dict)
    launch: int = 0
    clock_error_ns: int | None = None
    frame_age_lo_ns: int | None = None
    frame_age_hi_ns: int | None = None


@dataclass(frozen=True, slots=True)
class TokenRow:
    """One token: when it left the engine (null behind a black box) and when the client received it.

    On another host it left the engine between ``engine_lo_ns`` and ``engine_hi_ns``.
    """

    request_id: str
    cell: str
    index: int
    token_id: int
    text: str
    engine_ns: int | None
    client_ns: int
    engine_lo_ns: int | None = None
    engine_hi_ns: int | None = None


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame of a stream-mode run; ``used_by`` is the request that used it, or empty."""

    cell: str
    frame_index: int
    intended_ns: int
    marks: list[Mark] = field(default_factory=list)
    used_by: str = ""
    clock_error_ns: int | None = None


@dataclass(frozen=True, slots=True)
class SkillRow:
    """One skill of a plan: when its fragment was complete, and when it ran; ``stall_ns`` is the stall before it.

    Times count from the request. ``text`` is the call, empty if no model wrote one. ``due_ns`` is the time at which an
    executed skill could start; it is null if times were computed.
    """

    cell: str
    request_id: str
    plan: int
    index: int
    text: str
    arrival_ns: int
    start_ns: int
    end_ns: int
    stall_ns: int
    nominal_ns: int
    least_ns: int
    most_ns: int
    due_ns: int | None = None


def _stage_values(spent: Budget) -> dict[str, Value]:
    return {f"{stage}_ns": duration for stage, duration in spent.stages_ns.items()}


ONE_WAY: Final = ("network", "return")
"""The stages that begin on one side of the wire and end on the other."""
ROUND_TRIP: Final = "round_trip"
"""Both together, which no offset changes; a column of requests to another host."""
ONE_WAY_OF_FRAME: Final = ("network", "path", "latency")


def _as_intervals(values: dict[str, Value], names: Iterable[str], error_ns: int | None) -> dict[str, Value]:
    """Return ``values``, between two clocks with the ends of intervals in place of those of ``names``."""
    for name in names if error_ns is not None else ():
        middle_ns = values.pop(f"{name}_ns", None)
        if isinstance(middle_ns, int) and error_ns is not None:
            values |= {f"{name}_lo_ns": max(0, middle_ns - error_ns), f"{name}_hi_ns": middle_ns + error_ns}
    return values


def _ends(names: Iterable[str]) -> dict[str, Kind]:
    return {f"{name}_{end}_ns": "int64" for name in names for end in ("lo", "hi")}


FIRST_TOKEN: Final = frozenset({"return", "ingest", "server"})
"""A chain with one of these stages ends when the client receives the first token; the last two are of black boxes."""


def _derive_sample(row: SampleRow) -> dict[str, Value]:
    """Return a sample's durations; a chain that does not reach the first token has none."""
    if row.error or not any(stage in FIRST_TOKEN for stage, _ in row.marks):
        return {}
    spent = budget(row.marks)
    values = {**_stage_values(spent), **{name: of(row, spent) for name, (_, of) in _OF_SAMPLE.items()}}
    if row.clock_error_ns is not None:
        values[f"{ROUND_TRIP}_ns"] = sum(spent.stages_ns.get(stage, 0) for stage in ONE_WAY)
    return _as_intervals(values, ONE_WAY, row.clock_error_ns)


def _without_model_ns(row: SampleRow, spent: Budget) -> int | None:
    """Return e2e minus the model's time, which a llama-server reports, as its `ingest` includes preprocessing."""
    if "ingest" not in spent.stages_ns:
        return spent.e2e_without_model_ns
    model_ns = round((row.server_prompt_ms or 0) * 1e6)
    return spent.e2e_ns - model_ns if 0 < model_ns <= spent.e2e_ns else None


_OF_SAMPLE: Final[Mapping[str, tuple[Kind, Callable[[SampleRow, Budget], Value]]]] = {
    "e2e_ns": ("int64", lambda _, spent: spent.e2e_ns),
    "e2e_without_inference_ns": ("int64", lambda _, spent: spent.e2e_without_inference_ns),
    "e2e_without_model_ns": ("int64", _without_model_ns),
    "ttft_ns": ("int64", lambda _, spent: spent.e2e_ns - spent.stages_ns.get("capture", 0)),
    "residual_ns": ("int64", lambda _, spent: spent.residual_ns),
    "residual_share": ("float64", lambda _, spent: spent.residual_share),
}
"""Derived columns besides the stages; `ttft_ns` counts from the prompt, with which stream mode begins."""


def _derive_frame(row: FrameRow) -> dict[str, Value]:
    if not row.marks:
        return {}
    spent = budget(row.marks)
    whole = {"path_ns": spent.e2e_ns, "latency_ns": row.marks[-1][1] - row.intended_ns}
    values = {**_stage_values(spent), **whole, "residual_ns": spent.residual_ns}
    return _as_intervals(values, ONE_WAY_OF_FRAME, row.clock_error_ns)


TOKENS: Final[Table[TokenRow]] = Table("tokens", TokenRow)


def _derive_skill(row: SkillRow) -> dict[str, Value]:
    stretch = (row.end_ns - row.start_ns) / row.nominal_ns if row.nominal_ns else None
    jitter_ns = None if row.due_ns is None else row.start_ns - row.due_ns
    return {"queue_wait_ns": row.start_ns - row.arrival_ns, "stretch": stretch, "start_jitter_ns": jitter_ns}


SKILLS: Final[Table[SkillRow]] = Table(
    "skills",
    SkillRow,
    {"queue_wait_ns": "int64", "stretch": "float64", "start_jitter_ns": "int64"},
    _derive_skill,
)


def samples_table(stages: Mapping[str, str]) -> Table[SampleRow]:
    """Return the table of requests, with a column for each of a run's stages."""
    derived = {name: kind for name, (kind, _) in _OF_SAMPLE.items()}
    return Table(
        "samples",
        SampleRow,
        _columns(stages) | derived | _ends(ONE_WAY) | {f"{ROUND_TRIP}_ns": "int64"},
        _derive_sample,
    )


def frames_table(stages: Mapping[str, str]) -> Table[FrameRow]:
    """Return the table of frames in stream mode; `latency_ns` has no coordinated omission."""
    derived: dict[str, Kind] = {"path_ns": "int64", "latency_ns": "int64", "residual_ns": "int64"}
    return Table("frames", FrameRow, _columns(stages) | derived | _ends(ONE_WAY_OF_FRAME), _derive_frame)


def _columns(stages: Mapping[str, str]) -> dict[str, Kind]:
    return {f"{stage}_ns": "int64" for stage in stages}
