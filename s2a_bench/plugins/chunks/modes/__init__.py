"""When to act on actions in chunks: a mode decides when to request the next chunk, and which action a tick executes.

A policy answers an observation with a *chunk* of H actions, each meant for one control tick of Delta t:

- latency L: from the observation until the chunk is usable
- delay d: L in ticks, floor or ceil of L / Delta t (`Rounding`)
- execution horizon s: actions of a chunk that are executed before the next chunk takes over
- trigger m: actions left when the next request leaves
- stall: a tick, after the first action, that has no action to execute

A chunk is a plan whose steps all take Delta t: S0 = max_i (t_i - i Delta t) is `schedule.safe_start` of both.

Time is counted in whole control ticks, without floating point: latencies and Delta t are integer nanoseconds. A tick
begins with an observation and a request, where the mode decides so, and has one action or a stall. A chunk requested at
tick k is usable from tick k + d on. A request depends on what had arrived when the tick began, so the next request can
follow a chunk from tick k + ceil(L / Delta t) on, by either convention.

A simulation has one latency per request, and ends before the first request without one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from s2a_bench.errors import UsageError
from s2a_bench.policy import Floats
from s2a_bench.policy.parameters import build, canonical
from s2a_bench.registry import Registry

if TYPE_CHECKING:
    from s2a_bench.plugins.chunks.modes.closed import Closed

Ints: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]
Rounding: TypeAlias = Literal["floor", "ceil"]
"""floor: an action leaves at the end of its tick, so a chunk that arrives within it is in time (Real-time chunking,
arXiv 2506.07339). ceil: it leaves at the tick's start (lerobot). They differ by one tick unless L is a multiple of
Delta t."""

Pace: TypeAlias = "Generator[tuple[int, int], tuple[int, int], None]"
"""Yields the tick of each request and the actions left then, to be sent its d and ceil(L / Delta t)."""


@dataclass(frozen=True, slots=True)
class ControlSetting:
    """The control period Delta t, the prediction horizon H, and the convention for d."""

    period_ns: int
    horizon: int
    rounding: Rounding = "floor"

    def __post_init__(self) -> None:
        if self.period_ns < 1 or self.horizon < 1:
            raise ValueError(f"period {self.period_ns} ns and horizon {self.horizon} should be 1 or more")

    def delay_ticks(self, latency_ns: Ints) -> Ints:
        """Return d for latencies of any shape, in ns; raises ValueError for one below 0."""
        if latency_ns.size and latency_ns.min() < 0:
            raise ValueError(f"a latency of {latency_ns.min()} ns")
        return latency_ns // self.period_ns if self.rounding == "floor" else self.known_ticks(latency_ns)

    def delay(self, latency_ns: int) -> int:
        """Return d for one latency."""
        return latency_ns // self.period_ns if self.rounding == "floor" else -(-latency_ns // self.period_ns)

    def known_ticks(self, latency_ns: Ints) -> Ints:
        return -(-latency_ns // self.period_ns)

    def length(self, execute: int) -> int:
        """Return s: ``execute``, 0 for the whole chunk; raises ValueError if a chunk has fewer actions."""
        if execute > self.horizon:
            raise ValueError(f"execute = {execute} of a chunk of {self.horizon} actions")
        return execute or self.horizon

    def slowed(self, beta: float) -> ControlSetting:
        """Return the setting with all actions executed ``beta`` times slower (time-scaling), up to whole ns."""
        return ControlSetting(math.ceil(self.period_ns * beta), self.horizon, self.rounding)


@dataclass(frozen=True, slots=True)
class ChunkAction:
    """An action: its chunk, by request, and its index in that chunk, from 0."""

    request: int
    index: int


class ChunkStepper(Protocol):
    """One mode following one robot. Ticks never decrease; each tick calls `ask` once, then `act` once."""

    trigger: int = 0
    """Actions left at which it requests; set before every `ask` where the mode is `Mode.triggered`."""
    triggers: Sequence[int] = ()
    """The trigger of each request so far, where a rule chooses them."""
    past: int = 0
    """Past actions of the newest chunk, where the mode blends."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        """Record that the first ``actions`` actions of a request's chunk have arrived; requests count from 0."""

    def ask(self, tick: int) -> bool:
        """Return True to observe and to request a chunk now."""

    def act(self, tick: int) -> ChunkAction | None:
        """Return the action of this tick, None for no action."""


@dataclass(frozen=True, slots=True)
class Cycles:
    """The cycles of R requests: arrays of shape (R,), int64."""

    request_tick: Ints
    """When it left with an observation; ticks count from 0."""
    usable_tick: Ints
    """When the chunk was usable, streamed its first action: request_tick + d."""
    start_tick: Ints
    """When its first action was executed; the end of the simulation if none was."""
    first_index: Ints
    """Index of that action; 0 if none."""
    executed: Ints
    """Number of executed actions."""
    stall_ticks: Ints
    """Stalled ticks that ended with one of its actions; none before the very first action."""
    jump: Ints
    """first_index - actions executed since its observation: the robot jumps ahead by so many actions, or back where
    negative, if all chunks are one trajectory. 0 if the chunk takes over exactly where it is due."""
    ticks: int
    """Length of the simulation."""
    horizon: int

    @property
    def delay_ticks(self) -> Ints:
        return self.usable_tick - self.request_tick

    @property
    def thrown_away(self) -> Ints:
        """Return the number of actions of each chunk that were not executed by the end of the simulation."""
        return self.horizon - self.executed

    @property
    def settled(self) -> Flags:
        """Return a mask of the requests that count for P(stall): executed, without the first of them."""
        later: Flags = self.executed > 0
        if later.any():
            later[later.argmax()] = False
        return later


@dataclass(frozen=True, slots=True)
class Ticks:
    """K control ticks: arrays of shape (K,)."""

    chunk: Ints
    """Request whose chunk the action was from; -1 for no action."""
    index: Ints
    """Index of the action in the chunk; -1 for no action."""
    age: Ints
    """Ticks since the observation behind it; -1 for no action."""
    stalled: Flags
    """No action, after the first action."""


class Mode(Protocol):
    """A rule for requests and for taking over: a stepper, and where there are some the same `arrays`."""

    streams: ClassVar[bool] = False
    """Whether it acts on a chunk that has not arrived whole."""
    blocks: ClassVar[bool] = False
    """Whether the control loop waits for the answer."""
    triggered: ClassVar[bool] = False
    """Whether rules may choose its trigger, request by request: its stepper obeys `ChunkStepper.trigger`."""

    @property
    def name(self) -> str:
        """Return its name, as in MODES."""

    @property
    def several(self) -> bool:
        """Whether a request may leave while another one is pending."""
        return False

    @property
    def trigger(self) -> int | None:
        """Return m; None if requests do not depend on the actions left."""
        return None

    @property
    def assumed_ticks(self) -> int | None:
        """Return the d that it is ready for; None if it assumes nothing."""
        return self.trigger

    @property
    def gap_ns(self) -> int:
        """Return the time between the arrivals of two actions; 0 if chunks arrive whole."""
        return 0

    @property
    def weight(self) -> float:
        """Return the weight of a new action against an older one due at the same time; 1: it replaces it."""
        return 1.0

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        """Return a stepper for one robot, a subclass of `ChunkStepper`."""

    def varied(self, triggers: tuple[int, ...]) -> Mode:
        """Return the mode, if `triggered`, with one trigger per request; the last applies to all later requests."""
        from s2a_bench.plugins.chunks.modes.trigger import Varied

        return Varied(self, triggers)

    def execution_horizon(self, setting: ControlSetting) -> int:
        """Return s, the ticks for which a chunk is executed; raises ValueError if it has fewer actions."""
        return setting.horizon

    def slack(self, setting: ControlSetting) -> int | None:
        """Return the greatest d without stalls at the best trigger; None if slower actions do not help."""
        return self.execution_horizon(setting) - 1 if self.triggered else None

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:  # noqa: ARG002 - for subclasses
        """Return the closed forms of the steady state at latencies of shape (R,), in ns, R > 0."""
        from s2a_bench.plugins.chunks.modes.closed import Closed

        return Closed()

    def blended_age(self, cycles: Cycles) -> Floats | None:  # noqa: ARG002 - for subclasses
        """Return the weighted mean age behind each executed action in ticks, shape (K,), NaN for no action.

        `Ticks.age` is that of the newest observation in the blend. None if nothing is blended.
        """
        return None

    def pace(self, setting: ControlSetting) -> Pace | None:  # noqa: ARG002 - for subclasses
        """Return the requests without the stepper, one after another; None where `arrays` may be None."""
        return None

    def arrays(self, arrival_ns: Ints, setting: ControlSetting) -> Cycles | None:  # noqa: ARG002 - for subclasses
        """Return the cycles without the stepper, one run of ticks a chunk; None where only the stepper has them.

        ``arrival_ns`` is the arrival of every action after its request's tick began: shape (R, H), in ns.
        """
        return None

    def cycles(self, latency_ns: Ints, setting: ControlSetting) -> Cycles:
        """Return the cycles of requests with latencies of shape (R,), in ns; the first leaves at tick 0."""
        from s2a_bench.plugins.chunks.modes.cycles import arrivals, step

        return self.arrays(arrivals(self, latency_ns, setting), setting) or step(self, latency_ns, setting)[0]

    def ticks(self, latency_ns: Ints, setting: ControlSetting) -> Ticks:
        from s2a_bench.plugins.chunks.modes.cycles import arrivals, lay, step

        cycles = self.arrays(arrivals(self, latency_ns, setting), setting)
        return step(self, latency_ns, setting)[1] if cycles is None else lay(cycles)


MODES: Final[Registry[Callable[..., Mode]]] = Registry(
    "modes",
    "modes",
    {
        "sync": "s2a_bench.plugins.chunks.modes.append:Sync",
        "queue": "s2a_bench.plugins.chunks.modes.append:Queue",
        "streamed": "s2a_bench.plugins.chunks.modes.append:Streamed",
        "replace": "s2a_bench.plugins.chunks.modes.replace:Replace",
        "aggregate": "s2a_bench.plugins.chunks.modes.aggregate:Aggregate",
    },
)
"""Constructor of each mode; all parameters have defaults."""

COMPARED: Final = ("sync", "queue?trigger=6", "replace?execute=8", "aggregate?trigger=6")
"""Modes that commands compare by default."""

ONE_BY_ONE: Final = "sync?execute=1"
"""The mode that requests most often with one request pending: it warms loops up."""


def mode(written: str) -> Mode:
    """Build the mode ``name[?parameter=value&...]``; raises UsageError for an unknown name, parameter or value."""
    return build(MODES[written.partition("?")[0]], written, MODES.field)


def modes(written: Iterable[str], setting: ControlSetting) -> dict[str, Mode]:
    """Build each mode once, by its canonical name; raises UsageError, also for one that needs longer chunks."""
    by_name = {canonical(each.name, each): each for each in map(mode, written)}
    for name, each in by_name.items():
        try:
            each.execution_horizon(setting)
        except ValueError as error:
            raise UsageError(f"`modes`: {name}: a chunk has {setting.horizon} actions (`horizon`)") from error
    return by_name
