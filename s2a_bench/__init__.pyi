# ruff: noqa: PYI021 - editors show what a function does
"""The library's names, and the keywords of its functions. Written by tools/library_types.py."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, TypeAlias, TypedDict, TypeVar, overload

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

class _Shared1(TypedDict, total=False):
    action: str
    actions_per_chunk: int
    api_key_env: str
    cameras: int
    connection: Literal["keep-alive", "per-request", "client-per-request"]
    dds_tuning: Literal["tuned", "default"]
    deadline: float
    deadline_s: float
    device: str
    dialect: str
    domain_id: int | None
    extra_body: str
    layout: Literal["auto", "n1.7", "n1.6", "n1.5"]
    llama_server: str | Path | None
    max_frame_age: float
    middleware: str
    namespace: str
    nonce: str
    payload: _Several[str]
    policy_type: str
    port: int
    pretrained: str
    qos: Literal["reliable", "sensor_data"]
    resize: str | tuple[int, int] | None
    result_timeout: float
    router: str
    sample_resources: float
    sample_resources_hz: float
    served_model: str
    service: str
    size: str | tuple[int, int]
    state: int
    template: str
    timeout: float
    timeout_s: float
    transport: _Several[str]
    transports: _Several[str]
    url: str
    wait_for_server: float
    warmup: int

class _Shared2(TypedDict, total=False):
    closed_loop: bool
    episodes: float
    episodes_s: float
    limit: str
    looks: int
    plan_every: float | None
    plan_every_s: float | None
    robots: str | int
    settle: float | None
    settle_s: float | None

class _Shared3(TypedDict, total=False):
    follower: str
    front_gap: float
    front_gap_m: float
    gap: Literal["stop", "coast", "hold", "cruise"]
    gap_behaviour: Literal["stop", "coast", "hold", "cruise"]
    lane_change: bool
    lead_decel: float
    lead_decel_mps2: float
    plan_decel: float | None
    plan_decel_mps2: float | None
    reaction: float
    reaction_s: float
    rear_gap: float
    rear_gap_m: float
    reflex: bool
    simulator: str
    skills: int
    speed: float
    speed_kmh: float
    t_nom: float | None
    t_nom_s: float | None
    tokens_per_skill: int

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

class _CapacityMeasured(_Run, _Shared1, _Shared2, total=False):
    action_dim: int
    chat_template: str
    context: int
    control_hz: float
    engine: str
    flash_attention: str
    gaps: str
    gpu_layers: int
    horizon: int
    kv_type: str
    latency: str | float
    max_tokens: int
    mmproj: str | Path | None
    model: str | Path | None
    modes: _Several[str]
    pace: float | None
    processes: int
    profile: str
    prompt: str
    ray: str
    rounding: Literal["floor", "ceil"]
    sampling: str
    seconds: float
    seed: int
    source: str
    think: float
    think_s: float
    threads: int

class _CapacityPredicted(_Run, _Shared2, total=False):
    batch: str | Path | None
    control_hz: float
    horizon: int
    modes: _Several[str]
    predict: str
    rounding: Literal["floor", "ceil"]
    seconds: float
    seed: int
    servers: int
    think: float
    think_s: float

class _CcrbComputed(_Run, _Shared3, total=False):
    n_skills: int
    phase: bool
    phase_gaps: _Several[float]
    phase_gaps_m: _Several[float]
    phase_rates: _Several[float]
    policies: _Several[str]
    policy: _Several[str]
    profile: str
    prompt_s: float | None
    prompt_time: float | None
    random: int
    rate: float | None
    seed: int
    ttc: bool

class _CcrbLive(_Run, _Shared1, _Shared3, total=False):
    chat_template: str
    engine: str
    gpu_layers: int
    mmproj: str | Path | None
    model: str | Path | None
    n_skills: int
    pace: float | None
    policies: _Several[str]
    policy: _Several[str]
    profile: str
    record: str | Path | None
    seed: int
    threads: int
    ttc: bool

class _CcrbClosedLoop(_Run, _Shared3, total=False):
    n_skills: int
    policies: _Several[str]
    policy: _Several[str]
    profile: str
    prompt_s: float | None
    prompt_time: float | None
    rate: float | None
    seed: int

class _CcrbLiveLoop(_Run, _Shared1, _Shared3, total=False):
    chat_template: str
    ego: str
    engine: str
    gpu_layers: int
    mmproj: str | Path | None
    model: str | Path | None
    n_skills: int
    pace: float | None
    policies: _Several[str]
    policy: _Several[str]
    profile: str
    record: str | Path | None
    seed: int
    threads: int

class _ChunksVirtual(_Run, total=False):
    calibration_cycles: int
    control_hz: float
    cycles: int | None
    eps: float
    epsilon: float
    export_delays: str | Path | None
    guarantee: Literal["high-confidence", "expected"]
    horizon: int
    latency: _Several[str | float]
    modes: _Several[str]
    rounding: Literal["floor", "ceil"]
    rules: _Several[str]
    seed: int
    shown_ticks: int
    slow_down: float
    slowest: float
    tokens_per_action: int

class _ChunksLive(_Run, _Shared1, total=False):
    action_dim: int
    control_hz: float
    engine: str
    eps: float
    epsilon: float
    export_delays: str | Path | None
    gaps: str
    guarantee: Literal["high-confidence", "expected"]
    horizon: int
    latency: str | float
    modes: _Several[str]
    profile: str
    prompt: str
    robot: str
    rounding: Literal["floor", "ceil"]
    rules: _Several[str]
    seconds: float
    seed: int
    shown_ticks: int
    slow_down: float
    slowest: float
    source: str

class _Latency(_Run, _Shared1, total=False):
    action_dim: int
    answer: Literal["auto", "tokens", "actions"]
    chat_template: str
    clock: str
    context: int
    engine: str
    flash_attention: str
    fps: float
    gaps: str
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
    prompt: str
    quick: bool
    record: str | Path | None
    requests: int
    seed: int
    source: str
    think: float
    think_s: float
    threads: int

class _TaskVirtual(_Run, total=False):
    action_dim: int
    control_hz: float | None
    engine: str
    episodes: int
    horizon: int
    latency: _Several[str | float]
    margin: float
    modes: _Several[str]
    prompt: str
    robot: str
    rounding: Literal["floor", "ceil"]
    seed: int
    steps: int
    tokens_per_action: int

class _TaskLive(_Run, _Shared1, total=False):
    action_dim: int
    clock: str
    control_hz: float | None
    engine: str
    episodes: int
    gaps: str
    horizon: int
    latency: str | float
    link: str
    margin: float
    modes: _Several[str]
    profile: str
    prompt: str
    robot: str
    rounding: Literal["floor", "ceil"]
    seed: int
    source: str
    steps: int

class _Throughput(_Run, _Shared1, total=False):
    batch: int
    chat_template: str
    clock: str
    context: int
    engine: str
    flash_attention: str
    fps: float
    gaps: str
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
    prompt: str
    quick: bool
    record: str | Path | None
    reference: str | Path | None
    requests: int
    sampling: str
    seed: int
    source: str
    threads: int

class _TimelineComputed(_Run, total=False):
    calibrate: str | Path | None
    calibration_plans: int
    epsilon: float
    guarantee: Literal["high-confidence", "expected"]
    jitter: str
    n_skills: _Several[int]
    plans: int | None
    policies: _Several[str]
    policy: _Several[str]
    profile: _Several[str]
    profiles: _Several[str]
    prompt_s: float | None
    prompt_time: float | None
    rate: _Several[float]
    rates: _Several[float]
    seed: int
    t_max: float
    t_min: float
    t_nom: _Several[float]
    t_nom_cv: float
    t_nom_s: _Several[float]
    tokens_per_skill: _Several[int]
    track: bool

class _TimelineRealTime(_Run, total=False):
    calibrate: str | Path | None
    calibration_plans: int
    epsilon: float
    guarantee: Literal["high-confidence", "expected"]
    jitter: str
    n_skills: _Several[int]
    plans: int | None
    policies: _Several[str]
    policy: _Several[str]
    profile: _Several[str]
    profiles: _Several[str]
    prompt_s: float | None
    prompt_time: float | None
    rate: _Several[float]
    rates: _Several[float]
    seed: int
    t_max: float
    t_min: float
    t_nom: _Several[float]
    t_nom_cv: float
    t_nom_s: _Several[float]
    tokens_per_skill: _Several[int]
    track: bool

class _TimelineLive(_Run, _Shared1, total=False):
    chat_template: str
    engine: str
    epsilon: float
    gpu_layers: int
    mmproj: str | Path | None
    model: str | Path | None
    n_skills: _Several[int]
    no_grammar: bool
    pace: float | None
    policies: _Several[str]
    policy: _Several[str]
    profile: str
    requests: int
    robot: str
    seed: int
    skills: str
    source: str
    t_max: float
    t_min: float
    t_nom: _Several[float]
    t_nom_s: _Several[float]
    task: str
    threads: int
    tokens_per_skill: _Several[int]
    track: bool

class _WatchTap(_Run, total=False):
    control_hz: float | None
    listen: str
    no_auth: bool
    requests: int
    seconds: float
    to: str

class _WatchTopics(_Run, total=False):
    control_hz: float | None
    in_: str
    out: str
    requests: int
    seconds: float

class _WatchBag(_Run, total=False):
    bag: str | Path
    control_hz: float | None
    in_: str
    out: str
    requests: int
    seconds: float

def boundary(**options: Unpack[_Boundary]) -> Run:
    """Show at which rates and granularities naive execution never stalls: by formula, and by trying every point."""

@overload
def capacity(*, mode: Literal["measured"] = ..., **options: Unpack[_CapacityMeasured]) -> Run:
    """Find how many robots one server carries, each with its control clock: measured, or predicted."""

@overload
def capacity(*, mode: Literal["predicted"], **options: Unpack[_CapacityPredicted]) -> Run:
    """Find how many robots one server carries, each with its control clock: measured, or predicted."""

@overload
def ccrb(*, mode: Literal["computed"] = ..., **options: Unpack[_CcrbComputed]) -> Run:
    """Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when."""

@overload
def ccrb(*, mode: Literal["live"], **options: Unpack[_CcrbLive]) -> Run:
    """Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when."""

@overload
def ccrb(*, mode: Literal["closed-loop"], **options: Unpack[_CcrbClosedLoop]) -> Run:
    """Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when."""

@overload
def ccrb(*, mode: Literal["live-loop"], **options: Unpack[_CcrbLiveLoop]) -> Run:
    """Drive car-to-car rear braking with a car behind, under each policy: who hits whom, and when."""

@overload
def chunks(*, mode: Literal["virtual"] = ..., **options: Unpack[_ChunksVirtual]) -> Run:
    """Act on chunks of actions, computed or live: how often each mode and trigger stalls, on how old a picture."""

@overload
def chunks(*, mode: Literal["live"], **options: Unpack[_ChunksLive]) -> Run:
    """Act on chunks of actions, computed or live: how often each mode and trigger stalls, on how old a picture."""

def latency(**options: Unpack[_Latency]) -> Run:
    """Measure what the transport costs: HTTP/JSON + Base64 against ROS 2-native, every stage, one interleaved run."""

@overload
def task(*, mode: Literal["virtual"] = ..., **options: Unpack[_TaskVirtual]) -> Run:
    """Show what delay costs a task: success of a policy in a world against latency, computed or live."""

@overload
def task(*, mode: Literal["live"], **options: Unpack[_TaskLive]) -> Run:
    """Show what delay costs a task: success of a policy in a world against latency, computed or live."""

def throughput(**options: Unpack[_Throughput]) -> Run:
    """Measure tokens a second: prefill, time to first token, every gap between tokens, decode rate by position."""

@overload
def timeline(*, mode: Literal["computed"] = ..., **options: Unpack[_TimelineComputed]) -> Run:
    """Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live."""

@overload
def timeline(*, mode: Literal["real-time"], **options: Unpack[_TimelineRealTime]) -> Run:
    """Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live."""

@overload
def timeline(*, mode: Literal["live"], **options: Unpack[_TimelineLive]) -> Run:
    """Show when each policy acts on streamed skills, the same for all: computed, played in real time, or live."""

@overload
def watch(*, mode: Literal["tap"] = ..., **options: Unpack[_WatchTap]) -> Run:
    """Measure a robot that runs already: a tap between it and its server, ROS 2 topics, or a recording of them."""

@overload
def watch(*, mode: Literal["topics"], **options: Unpack[_WatchTopics]) -> Run:
    """Measure a robot that runs already: a tap between it and its server, ROS 2 topics, or a recording of them."""

@overload
def watch(*, mode: Literal["bag"], **options: Unpack[_WatchBag]) -> Run:
    """Measure a robot that runs already: a tap between it and its server, ROS 2 topics, or a recording of them."""
