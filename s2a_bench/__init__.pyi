# ruff: noqa: PYI021 - editors show what a function does
"""The library's names, and the keywords of its functions. Written by tools/library_types.py."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, TypeAlias, TypedDict, TypeVar

from typing_extensions import Unpack

from s2a_bench.library import Comparison as Comparison
from s2a_bench.library import Run as Run
from s2a_bench.library import compare as compare
from s2a_bench.library import load as load
from s2a_bench.progress import Progress

__version__: str

_T = TypeVar("_T")
_Several: TypeAlias = str | _T | Iterable[_T]  # text has commas between them

class _Run(TypedDict, total=False):
    output: str | Path
    progress: Progress | None
    tune: bool

class _CapacityChunksLatencyThroughput(TypedDict, total=False):
    action: str
    actions_per_chunk: int
    api_key_env: str
    cameras: int
    connection: Literal["keep-alive", "per-request", "client-per-request"]
    dds_tuning: Literal["tuned", "default"]
    deadline: float
    deadline_s: float
    device: str
    domain_id: int | None
    extra_body: str
    gaps: str
    layout: Literal["auto", "n1.7", "n1.6", "n1.5"]
    llama_server: str | Path | None
    max_frame_age: float
    middleware: str
    namespace: str
    payload: _Several[str]
    policy_type: str
    port: int
    pretrained: str
    prompt: str
    qos: Literal["reliable", "sensor_data"]
    resize: str | tuple[int, int] | None
    result_timeout: float
    router: str
    sample_resources: float
    sample_resources_hz: float
    served_model: str
    socket: str
    state: int
    template: str
    transport: _Several[str]
    transports: _Several[str]

class _CapacityChunksLatencyThroughputTimeline(TypedDict, total=False):
    dialect: str
    nonce: str
    size: str | tuple[int, int]
    source: str
    timeout: float
    timeout_s: float
    url: str
    wait_for_server: float
    warmup: int

class _Boundary(_Run, total=False):
    jitter: str
    most_tokens: int
    n_skills: int
    plans: int | None
    points: int | None
    profile: _Several[str]
    profiles: _Several[str]
    rates: _Several[float]
    seed: int
    t_min: float
    t_nom: float
    t_nom_s: float
    tokens_per_skill: _Several[int]

class _Capacity(_Run, _CapacityChunksLatencyThroughput, _CapacityChunksLatencyThroughputTimeline, total=False):
    action_dim: int
    batch: str | Path | None
    chat_template: str
    closed_loop: bool
    context: int
    control_hz: float
    engine: str
    episodes: float
    episodes_s: float
    flash_attention: str
    gpu_layers: int
    horizon: int
    kv_type: str
    latency: str | float
    limit: str
    looks: int
    max_tokens: int
    mmproj: str | Path | None
    model: str | Path | None
    modes: _Several[str]
    pace: float | None
    plan_every: float | None
    plan_every_s: float | None
    predict: str
    processes: int
    profile: str
    ray: str
    robots: str | int
    rounding: Literal["floor", "ceil"]
    sampling: str
    seconds: float
    seed: int
    servers: int
    settle: float | None
    settle_s: float | None
    think: float
    think_s: float
    threads: int

class _Ccrb(_Run, total=False):
    chat_template: str
    closed_loop: bool
    ego: str
    engine: str
    follower: str
    front_gap: float
    front_gap_m: float
    gap: Literal["stop", "coast", "hold", "cruise"]
    gap_behaviour: Literal["stop", "coast", "hold", "cruise"]
    lane_change: bool
    lead_decel: float
    lead_decel_mps2: float
    live: bool
    mmproj: str | Path | None
    model: str | Path | None
    n_skills: int
    pace: float | None
    phase: bool
    phase_gaps: _Several[float]
    phase_gaps_m: _Several[float]
    phase_rates: _Several[float]
    plan_decel: float | None
    plan_decel_mps2: float | None
    policies: _Several[str]
    policy: _Several[str]
    profile: str
    prompt_s: float | None
    prompt_time: float | None
    random: int
    rate: float | None
    reaction: float
    reaction_s: float
    rear_gap: float
    rear_gap_m: float
    record: str | Path | None
    reflex: bool
    seed: int
    simulator: str
    skills: int
    speed: float
    speed_kmh: float
    t_nom: float | None
    t_nom_s: float | None
    threads: int
    tokens_per_skill: int
    transport: str
    ttc: bool

class _Chunks(_Run, _CapacityChunksLatencyThroughput, _CapacityChunksLatencyThroughputTimeline, total=False):
    action_dim: int
    calibration_cycles: int
    control_hz: float
    cycles: int | None
    engine: str
    eps: float
    epsilon: float
    export_delays: str | Path | None
    guarantee: Literal["high-confidence", "expected"]
    horizon: int
    latency: _Several[str | float]
    live: bool
    modes: _Several[str]
    profile: str
    robot: str
    rounding: Literal["floor", "ceil"]
    rules: _Several[str]
    seconds: float
    seed: int
    shown_ticks: int
    slow_down: float
    slowest: float
    tokens_per_action: int

class _Latency(_Run, _CapacityChunksLatencyThroughput, _CapacityChunksLatencyThroughputTimeline, total=False):
    action_dim: int
    answer: Literal["auto", "tokens", "actions"]
    chat_template: str
    clock: str
    context: int
    engine: str
    flash_attention: str
    fps: float
    gpu_layers: int
    grammar: str
    horizon: int
    latency: str | float
    launches: int
    link: str
    max_tokens: int
    mmproj: str | Path | None
    mode: Literal["request", "stream"]
    model: str | Path | None
    profile: str
    quick: bool
    record: str | Path | None
    requests: int
    seed: int
    think: float
    think_s: float
    threads: int

class _Throughput(_Run, _CapacityChunksLatencyThroughput, _CapacityChunksLatencyThroughputTimeline, total=False):
    batch: int
    chat_template: str
    clock: str
    context: int
    engine: str
    flash_attention: str
    fps: float
    gpu_layers: int
    grammar: str
    kv_type: str
    launches: int
    link: str
    max_tokens: int
    mmproj: str | Path | None
    mode: Literal["request", "stream"]
    model: str | Path | None
    profile: str
    quick: bool
    record: str | Path | None
    reference: str | Path | None
    requests: int
    sampling: str
    seed: int
    threads: int

class _Timeline(_Run, _CapacityChunksLatencyThroughputTimeline, total=False):
    calibrate: str | Path | None
    calibration_plans: int
    chat_template: str
    engine: str
    epsilon: float
    gpu_layers: int
    guarantee: Literal["high-confidence", "expected"]
    jitter: str
    live: bool
    mmproj: str | Path | None
    model: str | Path | None
    n_skills: _Several[int]
    no_grammar: bool
    pace: float | None
    plans: int | None
    policies: _Several[str]
    policy: _Several[str]
    profile: _Several[str]
    profiles: _Several[str]
    prompt_s: float | None
    prompt_time: float | None
    rate: _Several[float]
    rates: _Several[float]
    real_time: bool
    requests: int
    robot: str
    seed: int
    skills: str
    t_max: float
    t_min: float
    t_nom: _Several[float]
    t_nom_cv: float
    t_nom_s: _Several[float]
    task: str
    threads: int
    tokens_per_skill: _Several[int]
    track: bool
    transport: str

def boundary(**options: Unpack[_Boundary]) -> Run:
    """Show at which rates and granularities naive execution never stalls: by formula, and by trying every point."""

def capacity(**options: Unpack[_Capacity]) -> Run:
    """Find how many robots one server carries, each with its control clock: measured, or predicted."""

def ccrb(**options: Unpack[_Ccrb]) -> Run:
    """Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when."""

def chunks(**options: Unpack[_Chunks]) -> Run:
    """Act on chunks of actions, computed or live: how often each mode and trigger stalls, on how old a picture."""

def latency(**options: Unpack[_Latency]) -> Run:
    """Measure what the transport costs: HTTP/JSON + Base64 against ROS 2-native, every stage, one interleaved run."""

def throughput(**options: Unpack[_Throughput]) -> Run:
    """Measure tokens a second: prefill, time to first token, every gap between tokens, decode rate by position."""

def timeline(**options: Unpack[_Timeline]) -> Run:
    """Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live."""
