"""When to act on actions in chunks: a mode says when to ask for the next chunk, and which action each tick executes.

A policy answers an observation with a *chunk* of H actions, each meant for one control tick of Delta t. The words:

| word | meaning |
|---|---|
| latency L | from the observation until the chunk is usable |
| delay d | L in ticks, by a named convention (`Rounding`): floor or ceil of L / Delta t |
| execution horizon s | actions of a chunk that are executed before the next one takes over |
| trigger m | actions left when the next request leaves |
| stall | a tick, after the first action, that finds no action to execute |

A chunk is a plan whose pieces all take Delta t (`skills.as_plans`), and a plan of skills is a chunk whose pieces differ
in length: S0 = max_i (t_i - i Delta t) is `schedule.safe_start` of both.

Time is counted in whole control ticks, and nothing is compared in floating point: latencies and Delta t are integer
nanoseconds. A tick begins with observing and asking, where the mode says so, and has one action or a stall. A chunk
asked for at tick k is usable from tick k + d on. Asking looks at what had arrived when the tick began, so that a chunk
can have a request follow from tick k + ceil(L / Delta t) on, by either convention.

A simulation has one latency a request, and ends where there is none for the next: all ticks before are decided.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, Protocol, TypeAlias

from s2a_bench.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Ints: TypeAlias = NDArray[np.int64]
    Flags: TypeAlias = NDArray[np.bool_]

Rounding: TypeAlias = Literal["floor", "ceil"]
"""floor: an action leaves at the end of its tick, so that one whose chunk arrives within the tick is in time (Real-time
chunking, arXiv 2506.07339). ceil: it leaves at the tick's start (lerobot). They differ by one tick unless L
is a multiple of Delta t."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What all modes are told: the control period Delta t, the prediction horizon H, and how L becomes d."""

    period_ns: int
    horizon: int
    rounding: Rounding = "floor"

    def __post_init__(self) -> None:
        """Refuse what is no setting; raises ValueError."""
        if self.period_ns < 1 or self.horizon < 1:
            raise ValueError(f"period {self.period_ns} ns and horizon {self.horizon} should be 1 or more")

    def delay_ticks(self, latency_ns: Ints) -> Ints:
        """Return d for latencies of any shape, in ns; raises ValueError for one below 0."""
        if latency_ns.size and latency_ns.min() < 0:
            raise ValueError(f"a latency of {latency_ns.min()} ns")
        return latency_ns // self.period_ns if self.rounding == "floor" else self.known_ticks(latency_ns)

    def known_ticks(self, latency_ns: Ints) -> Ints:
        """Return after how many ticks a request may follow from the answer: ceil(L / Delta t)."""
        return -(-latency_ns // self.period_ns)

    def slowed(self, beta: float) -> Setting:
        """Return the setting with all actions executed ``beta`` times slower (time-scaling), up to whole ns."""
        return Setting(math.ceil(self.period_ns * beta), self.horizon, self.rounding)


@dataclass(frozen=True, slots=True)
class Action:
    """One action: which request's chunk it is from, and its place in that chunk, from 0."""

    request: int
    index: int


class ChunkStepper(Protocol):
    """One mode following one robot. Ticks never decrease; each tick asks `ask` once, then `act` once."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        """Learn that the first ``actions`` actions of a request's chunk are here; requests count from 0."""
        ...

    def ask(self, tick: int) -> bool:
        """Return whether to observe and to ask now."""
        ...

    def act(self, tick: int) -> Action | None:
        """Return what to execute in this tick, None where there is nothing."""
        ...


@dataclass(frozen=True, slots=True)
class Cycles:
    """What became of each of R requests: arrays of shape (R,), int64."""

    request_tick: Ints
    """When it left with an observation; ticks count from 0."""
    usable_tick: Ints
    """When the whole chunk was usable: request_tick + d."""
    start_tick: Ints
    """When its first action was executed; the end of the simulation where none was."""
    first_index: Ints
    """Which of its actions that was; 0 where none was."""
    executed: Ints
    """How many of its actions were."""
    stall_ticks: Ints
    """Stalled ticks that ended with one of its actions; none before the very first action."""
    jump: Ints
    """first_index - actions executed since its observation: by so many actions the robot is thrown ahead, or back where
    below 0, were all chunks one trajectory. 0 where the chunk takes over exactly where it is due."""
    ticks: int
    """Length of the simulation."""
    horizon: int

    @property
    def delay_ticks(self) -> Ints:
        """Return d of each request."""
        return self.usable_tick - self.request_tick

    @property
    def thrown_away(self) -> Ints:
        """Return how many actions of each chunk were never executed; of those that end the simulation, not yet."""
        return self.horizon - self.executed

    @property
    def settled(self) -> Flags:
        """Return which requests have a boundary that counts for P(stall): executed, and not the first one's."""
        later: Flags = self.executed > 0
        if later.any():
            later[later.argmax()] = False
        return later


@dataclass(frozen=True, slots=True)
class Ticks:
    """What each of K control ticks did: arrays of shape (K,)."""

    chunk: Ints
    """Which request's chunk the action was from; -1 for no action."""
    index: Ints
    """The action's place in the chunk; -1 for no action."""
    age: Ints
    """Ticks since the observation behind it; -1 for no action."""
    stalled: Flags
    """No action, though the robot had begun."""


class Mode(Protocol):
    """A rule for asking and for taking over; a subclass of this one gets `cycles` and `ticks` from its stepper."""

    @property
    def name(self) -> str:
        """Return its name, as in MODES."""
        ...

    @property
    def gap_ns(self) -> int:
        """Return the time from one action's arrival to the next one's; 0 where chunks arrive whole."""
        return 0

    @property
    def streams(self) -> bool:
        """Return whether it acts on a chunk that has not arrived whole."""
        return False

    @property
    def weight(self) -> float:
        """Return the share of a new action where it meets one that is due at the same time; 1: it takes its place."""
        return 1.0

    @property
    def blocks(self) -> bool:
        """Return whether the control loop waits for the answer."""
        return False

    def stepper(self, setting: Setting) -> ChunkStepper:
        """Follow one robot."""
        ...

    def cycles(self, latency_ns: Ints, setting: Setting) -> Cycles:
        """Say what becomes of requests with latencies of shape (R,), in ns; the first leaves at tick 0."""
        from s2a_bench.policy.chunks.stepping import step

        return step(self, latency_ns, setting)[0]

    def ticks(self, latency_ns: Ints, setting: Setting) -> Ticks:
        """Say what each tick does, for the same requests."""
        from s2a_bench.policy.chunks.stepping import step

        return step(self, latency_ns, setting)[1]


MODES: Final[Registry[Callable[..., Mode]]] = Registry(
    "modes",
    "mode",
    {
        "sync": "s2a_bench.policy.chunks.append:Sync",
        "queue": "s2a_bench.policy.chunks.append:Queue",
        "streamed": "s2a_bench.policy.chunks.append:Streamed",
        "replace": "s2a_bench.policy.chunks.replace:Replace",
        "aggregate": "s2a_bench.policy.chunks.aggregate:Aggregate",
    },
)
"""What builds each mode from its parameters, which all have defaults."""


def mode(written: str) -> Mode:
    """Build the mode ``name[?parameter=value&...]``; raises UsageError for an unknown name, parameter or value."""
    from s2a_bench.policy.parameters import build

    return build(MODES[written.partition("?")[0]], written, MODES.field)
