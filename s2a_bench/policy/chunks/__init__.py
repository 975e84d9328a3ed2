"""When to act on actions in chunks: a mode says when to ask for the next chunk, and which action each tick executes.

A policy answers an observation with a *chunk* of H actions, each meant for one control tick of Delta t. The words:

| word | meaning |
|---|---|
| latency L | from the observation until the chunk is usable |
| delay d | L in ticks, by a named convention (`Rounding`): floor or ceil of L / Delta t |
| execution horizon s | actions of a chunk that are executed before the next one takes over |
| trigger m | actions left when the next request leaves |
| stall | a tick, after the first action, that finds no action to execute |

A chunk is a plan whose pieces all take Delta t, and a plan of skills is a chunk whose pieces differ in length:
S0 = max_i (t_i - i Delta t) is `schedule.safe_start` of both.

Time is counted in whole control ticks, and nothing is compared in floating point: latencies and Delta t are integer
nanoseconds. A tick begins with observing and asking, where the mode says so, and has one action or a stall. A chunk
asked for at tick k is usable from tick k + d on. Asking looks at what had arrived when the tick began, so that a chunk
can have a request follow from tick k + ceil(L / Delta t) on, by either convention.

A simulation has one latency a request, and ends where there is none for the next: all ticks before are decided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal, Protocol, TypeAlias

from s2a_bench.errors import UsageError
from s2a_bench.registry import Registry

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2a_bench.policy import Floats
    from s2a_bench.policy.chunks.closed import Closed

Ints: TypeAlias = "NDArray[np.int64]"
Flags: TypeAlias = "NDArray[np.bool_]"
Rounding: TypeAlias = Literal["floor", "ceil"]
"""floor: an action leaves at the end of its tick, so that one whose chunk arrives within the tick is in time (Real-time
chunking, arXiv 2506.07339). ceil: it leaves at the tick's start (lerobot). They differ by one tick unless L
is a multiple of Delta t."""


@dataclass(frozen=True, slots=True)
class ControlSetting:
    """What all modes are told: the control period Delta t, the prediction horizon H, and how L becomes d."""

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

    def known_ticks(self, latency_ns: Ints) -> Ints:
        """Return after how many ticks a request may follow from the answer: ceil(L / Delta t)."""
        return -(-latency_ns // self.period_ns)

    def length(self, execute: int) -> int:
        """Return s: ``execute``, 0 for the whole chunk; raises ValueError where a chunk has fewer actions."""
        if execute > self.horizon:
            raise ValueError(f"execute = {execute} of a chunk of {self.horizon} actions")
        return execute or self.horizon

    def slowed(self, beta: float) -> ControlSetting:
        """Return the setting with all actions executed ``beta`` times slower (time-scaling), up to whole ns."""
        return ControlSetting(math.ceil(self.period_ns * beta), self.horizon, self.rounding)


@dataclass(frozen=True, slots=True)
class ChunkAction:
    """One action: which request's chunk it is from, and its place in that chunk, from 0."""

    request: int
    index: int


class ChunkStepper(Protocol):
    """One mode following one robot. Ticks never decrease; each tick asks `ask` once, then `act` once."""

    trigger: int = 0
    """How many actions may be left when it asks: set before every `ask` where the mode is `Mode.triggered`."""
    triggers: Sequence[int] = ()
    """The trigger of each request so far, where a rule chooses them."""
    past: int = 0
    """How many actions of the newest chunk are past, where the mode blends."""

    def arrived(self, request: int, actions: int, tick: int) -> None:
        """Learn that the first ``actions`` actions of a request's chunk are here; requests count from 0."""

    def ask(self, tick: int) -> bool:
        """Return whether to observe and to ask now."""

    def act(self, tick: int) -> ChunkAction | None:
        """Return what to execute in this tick, None where there is nothing."""


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
    """A rule for asking and for taking over; a subclass of this one gets `cycles` and `ticks` from its stepper.

    The stepper is a subclass of `ChunkStepper`.
    """

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
        """Whether a request may leave while another one is under way."""
        return False

    @property
    def trigger(self) -> int | None:
        """Return m; None where it does not ask by the actions that are left."""
        return None

    @property
    def assumed_ticks(self) -> int | None:
        """Return the d that it is ready for; None where it assumes nothing."""
        return self.trigger

    @property
    def gap_ns(self) -> int:
        """Return the time from one action's arrival to the next one's; 0 where chunks arrive whole."""
        return 0

    @property
    def weight(self) -> float:
        """Return the share of a new action where it meets one that is due at the same time; 1: it takes its place."""
        return 1.0

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        """Follow one robot."""

    def varied(self, triggers: tuple[int, ...]) -> Mode:
        """Return it with a trigger for each request, the last one ever after, where it is `triggered`."""
        from s2a_bench.policy.chunks.trigger import Varied

        return Varied(self, triggers)

    def execution_horizon(self, setting: ControlSetting) -> int:
        """Return s, for how many ticks a chunk is to be executed; raises ValueError where it has fewer actions."""
        return setting.horizon

    def slack(self, setting: ControlSetting) -> int | None:
        """Return the greatest d that its best trigger would not stall with; None where slower actions do not help."""
        return self.execution_horizon(setting) - 1 if self.triggered else None

    def closed_form(self, latency_ns: Ints, setting: ControlSetting) -> Closed:  # noqa: ARG002 - for subclasses
        """Say what follows without a simulation from latencies of shape (R,), in ns, R > 0, of the steady state."""
        from s2a_bench.policy.chunks.closed import Closed

        return Closed()

    def blend(self, cycles: Cycles, ticks: Ticks) -> Iterator[tuple[Ints, Ints, Ints, Floats]]:  # noqa: ARG002
        """Yield what executed actions are made of: in which ticks, whose chunk, which action of it, with which weight.

        All that is newest comes first, then what is next to newest. The weights of a tick add up to 1.
        """
        import numpy as np

        acted = np.flatnonzero(ticks.chunk >= 0)
        yield acted, ticks.chunk[acted], ticks.index[acted], np.ones(acted.size)

    def blended_age(self, cycles: Cycles) -> Floats | None:  # noqa: ARG002 - for subclasses
        """Return the mean age behind each executed action in ticks, shape (K,), NaN for no action.

        Ages are weighted as actions are; `Ticks.age` is that of the newest observation in the blend. None where nothing
        is blended.
        """
        return None

    def cycles(self, latency_ns: Ints, setting: ControlSetting) -> Cycles:
        """Say what becomes of requests with latencies of shape (R,), in ns; the first leaves at tick 0."""
        from s2a_bench.policy.chunks.cycles import step

        return step(self, latency_ns, setting)[0]

    def ticks(self, latency_ns: Ints, setting: ControlSetting) -> Ticks:
        """Say what each tick does, for the same requests."""
        from s2a_bench.policy.chunks.cycles import step

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

COMPARED: Final = ("sync", "queue?trigger=6", "replace?execute=8", "aggregate?trigger=6")
"""What commands compare unless told."""


def mode(written: str) -> Mode:
    """Build the mode ``name[?parameter=value&...]``; raises UsageError for an unknown name, parameter or value."""
    from s2a_bench.policy.parameters import build

    return build(MODES[written.partition("?")[0]], written, MODES.field)


def streams(written: str) -> bool:
    """Whether a mode acts on chunks that have not arrived whole; False for one whose package is not installed."""
    try:
        return mode(written).streams
    except UsageError:
        return False
