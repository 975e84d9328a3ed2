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


@dataclass(frozen=True, slots=True)
class ResourceRow:
    """One reading of one reader; ``cost_ns`` is how long reading took, ``at_ns`` (CLOCK_MONOTONIC) its middle.

    Columns whose names end in ``_cpu_ns`` or ``_energy_j`` count up from some moment; the others hold for the moment.
    ``client`` is the harness, ``server`` all servers together; ``*_busy`` are shares from 0 to 1.
    """

    at_ns: int
    reader: str
    cost_ns: int
    client_cpu_ns: int | None = None
    server_cpu_ns: int | None = None
    client_rss_bytes: int | None = None
    server_rss_bytes: int | None = None
    memory_available_bytes: int | None = None
    cpu_busy: float | None = None
    package_energy_j: float | None = None
    gpu_busy: float | None = None
    gpu_memory_bytes: int | None = None
    gpu_power_w: float | None = None
    gpu_energy_j: float | None = None
    gpu_temperature_c: float | None = None
    gpu_clock_hz: float | None = None
    board_power_w: float | None = None


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


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One cell of a study: plans drawn from one world, decided by one policy.

    ``family`` names the gaps' distribution, ``condition`` what else was varied and ``block`` which stretch of a
    sequence of plans it is. Regrets are means over the plans, as `policy.metrics` defines them; ``caution`` is null
    where the policy waits for whole plans or knows no lambda; ``p_any_stall_high`` is the upper end of the two-sided
    95 % Clopper-Pearson interval. Nothing in a study is measured: the plans are drawn.
    """

    study: str
    policy: str
    tokens_per_s: float
    prompt_s: float
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    rho: float
    family: str
    condition: str
    block: int
    caution: float | None
    calibration_plans: int
    plans: int
    stalled: int
    p_any_stall: float
    p_any_stall_high: float
    start_s: float
    end_s: float
    start_regret: float
    signed_start_regret: float
    start_regret_of_wait: float
    end_regret: float
    end_regret_of_wait: float


@dataclass(frozen=True, slots=True)
class TimelineRow:
    """One plan under one policy, with its metrics as `policy.metrics` defines them; times count from the request.

    ``board`` is a profile's name, empty where only a rate was given. ``mode`` says what passed the time: ``virtual``
    (computed), else a clock; ``emulated`` is true where no model answered. ``requested_ns`` is when the clock showed
    the request: 0 in virtual time. ``safe_start_ns`` is S0, ``last_arrival_ns`` t_N, ``safe_end_ns`` S0 + P_N,
    ``least_end_ns`` E_lo. ``any_stall`` counts stalls too short for ``stalls``. Motion is null for plans whose skills
    are not kept.
    """

    cell: str
    policy: str
    board: str
    title: str
    mode: str
    emulated: bool
    tokens_per_s: float
    prompt_s: float | None
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    plan: int
    request_id: str
    requested_ns: int
    caution: float | None
    start_ns: int
    end_ns: int
    safe_start_ns: int
    last_arrival_ns: int
    safe_end_ns: int
    least_end_ns: int
    stalls: int
    any_stall: bool
    stall_ns: int
    longest_stall_ns: int
    stall_ratio: float
    start_regret: float
    signed_start_regret: float
    start_regret_of_wait: float
    end_regret: float
    end_regret_of_wait: float
    end_regret_elastic: float
    mean_queue_wait_ns: int
    longest_queue_wait_ns: int
    mean_action_age_ns: int
    oldest_action_ns: int
    speed_distortion: float
    fluidity: float
    rms_jerk: float | None = None
    peak_jerk: float | None = None
    sparc: float | None = None


@dataclass(frozen=True, slots=True)
class SkillRow:
    """One skill of a plan: when its fragment was complete, when it ran; ``stall_ns`` is the stall before it.

    Times count from the request. ``text`` is the call, empty where no model wrote one. ``due_ns``, of skills that were
    really executed, is when the reason to start was there; it is null where times were computed.
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


@dataclass(frozen=True, slots=True)
class BoundaryRow:
    """One point of the plane of tokens per skill and rate: whether naive is stall-free there, by formula and by trial.

    ``duration`` names what every skill takes: t_nom or t_min. ``board`` is the profile that has this rate, empty for
    points of the grid. ``stall_free`` is the formula's answer, ``p_stall`` the share of ``plans`` that stalled.
    """

    duration: str
    duration_s: float
    tokens_per_skill: int
    tokens_per_s: float
    board: str
    n_skills: int
    family: str
    plans: int
    stall_free: bool
    p_stall: float


@dataclass(frozen=True, slots=True)
class RolloutRow:
    """One roll-out of the driving scenario: what was tried, and what became of the cars. SI units.

    ``study`` is what it belongs to: point, phase or random; ``draw`` counts its scenarios. ``title`` names the board.
    ``late`` says that s2a-ttc could not keep the deadline ``deadline_ns`` (S_front) without stalls; null for others.
    Studies end when the outcome is decided, and have no least rear gap but that of an impact.
    Impact speeds are null without that impact, times to collision where the cars never closed in, the required
    deceleration (DRAC, to the lead) with a front impact, motion where no trajectory is kept, ``prompt_s`` where a model
    took what it took.
    """

    cell: str
    study: str
    draw: int
    policy: str
    board: str
    title: str
    emulated: bool
    simulator: str
    follower: str
    gap_behaviour: str
    reflex: bool
    lane_change: bool
    tokens_per_s: float
    prompt_s: float | None
    tokens_per_skill: int
    n_skills: int
    t_nom_s: float
    speed_mps: float
    plan_decel_mps2: float
    front_gap_m: float
    lead_decel_mps2: float
    rear_gap_m: float
    reaction_s: float
    start_ns: int
    end_ns: int
    stalls: int
    stall_ns: int
    deadline_ns: int
    late: bool | None
    outcome: str
    impact_speed_mps: float | None
    front_impact_mps: float | None
    rear_impact_mps: float | None
    min_front_gap_m: float
    min_rear_gap_m: float | None
    min_front_ttc_s: float | None
    min_rear_ttc_s: float | None
    required_decel_mps2: float | None
    rms_jerk: float | None = None
    peak_jerk: float | None = None
    sparc: float | None = None


@dataclass(frozen=True, slots=True)
class TrajectoryRow:
    """The three cars of a shown roll-out at one time from the request; positions are bumper to bumper.

    ``phase`` says what the ego does: waiting, acting, gap or done; ``skill`` counts from 0, -1 before the first.
    """

    cell: str
    at_ns: int
    phase: str
    skill: int
    lead_position_m: float
    ego_position_m: float
    rear_position_m: float
    ego_lateral_m: float
    lead_speed_mps: float
    ego_speed_mps: float
    rear_speed_mps: float
    lead_acceleration_mps2: float
    ego_acceleration_mps2: float
    rear_acceleration_mps2: float


@dataclass(frozen=True, slots=True)
class ValidityRow:
    """One answer of a model that was asked for a plan of ``n_skills``, with the grammar or without.

    ``format`` is what was asked for: paper, or tokens a skill; ``wording`` what that is with this model. ``lines`` are
    those that count, the first ``n_skills`` of the answer; ``skills`` the valid ones, ``problems`` the others by kind.
    ``cut`` says that the answer ended because its tokens were used up.
    """

    format: str
    wording: str
    skill_set: str
    n_skills: int
    grammar: bool
    seed: int
    tokens: int
    cut: bool
    lines: int
    skills: int
    problems: dict[str, int]
    as_ordered: bool
    text: str


@dataclass(frozen=True, slots=True)
class CellRow:
    """One attempt at one cell of a sweep; the latest attempt of a cell is the one that counts.

    ``cell`` names the setting and ``repeat`` which time it ran. ``state`` is finished or failed, ``error`` why.
    ``board`` is the machine that the cell asked for, empty where any would do; ``host`` the one that it got.
    ``folder`` is its run folder below the sweep's, empty where it did not come to have one.
    """

    cell: str
    repeat: int
    attempt: int
    state: str
    error: str
    virtual: bool
    board: str
    host: str
    settings: dict[str, Any]
    argv: list[str]
    config_hash: str
    folder: str
    started: str
    wall_s: float


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

RESOURCES: Final[Table[ResourceRow]] = Table("resources", _columns(ResourceRow, {}), lambda _row: {})
"""One row a reading beside the run."""

REFERENCE: Final[Table[ReferenceRow]] = Table("reference", _columns(ReferenceRow, {}), lambda _row: {})
"""One row a run of the reference program."""

STUDIES: Final[Table[StudyRow]] = Table("studies", _columns(StudyRow, {}), lambda _row: {})
"""One row a cell of a study."""

TIMELINES: Final[Table[TimelineRow]] = Table("timelines", _columns(TimelineRow, {}), lambda _row: {})
"""One row a plan and policy."""


def _derive_skill(row: SkillRow) -> dict[str, Value]:
    """Compute how long a skill lay ready, its duration over the nominal one, and how late the robot had the order."""
    stretch = (row.end_ns - row.start_ns) / row.nominal_ns if row.nominal_ns else None
    jitter_ns = None if row.due_ns is None else row.start_ns - row.due_ns
    return {"queue_wait_ns": row.start_ns - row.arrival_ns, "stretch": stretch, "start_jitter_ns": jitter_ns}


SKILLS: Final[Table[SkillRow]] = Table(
    "skills",
    _columns(SkillRow, {"queue_wait_ns": "int64", "stretch": "float64", "start_jitter_ns": "int64"}),
    _derive_skill,
)
"""One row a skill."""

BOUNDARY: Final[Table[BoundaryRow]] = Table("boundary", _columns(BoundaryRow, {}), lambda _row: {})
"""One row a point of the plane."""

ROLLOUTS: Final[Table[RolloutRow]] = Table("rollouts", _columns(RolloutRow, {}), lambda _row: {})
"""One row a roll-out of the driving scenario."""

TRAJECTORIES: Final[Table[TrajectoryRow]] = Table("trajectories", _columns(TrajectoryRow, {}), lambda _row: {})
"""One row a moment of a shown roll-out."""

VALIDITY: Final[Table[ValidityRow]] = Table("validity", _columns(ValidityRow, {}), lambda _row: {})
"""One row an answer that was asked for to see whether its skills are valid."""

CELLS: Final[Table[CellRow]] = Table("cells", _columns(CellRow, {}), lambda _row: {})
"""One row an attempt at a cell of a sweep."""

TABLES: Final[dict[str, Table[Any]]] = {
    table.name: table
    for table in (
        SAMPLES,
        TOKENS,
        FRAMES,
        RESOURCES,
        REFERENCE,
        STUDIES,
        TIMELINES,
        SKILLS,
        BOUNDARY,
        ROLLOUTS,
        TRAJECTORIES,
        VALIDITY,
        CELLS,
    )
}
"""Every table a run folder may hold, by its file's name."""
