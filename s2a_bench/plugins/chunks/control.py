"""Act on chunks of actions: robots at control rate, on one thread that nothing blocks.

Ticks begin at fixed times. A tick depends on what had arrived by its time, not by the time the thread woke up: requests
see what had arrived when the tick began; an action leaves at the end of its tick if d is the floor of latency over
control tick, at its start if d is the ceiling (`modes.Rounding`). So the loop does the same as virtual time
(`modes.cycles.follow`), and lateness is recorded beside it. The loop catches up after a late tick.
"""

from __future__ import annotations

import gc
import heapq
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Thread
from typing import Final, TypeAlias

import numpy as np

from s2a_bench.clock import Clock, SystemClock, quick_switching
from s2a_bench.plugins.chunks.modes import ControlSetting, Ints, Mode
from s2a_bench.types import Vector

Send: TypeAlias = "Callable[[Vector | None, int], None]"
"""Called in every tick with its action, None for no action, and its due time in ns."""
RequestChunk: TypeAlias = "Callable[[int, int], None]"
"""Called on the loop's thread with a request's number, from 0, and the tick in which it leaves; must not block."""

ENDLESS: Final = 2**62
"""Ticks of a loop that is stopped."""
HEAD_START_NS: Final = 20_000_000
"""Time from `ControlLoop.start` to the first tick."""


@dataclass(frozen=True, slots=True, eq=False)
class Acted:
    """Record of a loop: arrays of shape (K,), int64, one value per tick."""

    start_ns: int
    """When the first tick began."""
    chunk: Ints
    """Request whose chunk the action was from; -1 for no action."""
    index: Ints
    """Index of the action in the chunk; -1 for no action."""
    late_ns: Ints
    """Delay of the action after its due time."""
    busy_ns: Ints
    """Time spent on requesting and sending, without waiting."""
    request_tick: Ints
    """When each request left: shape (R,)."""
    arrival_ns: Ints
    """Arrival of each action after that tick began: shape (R, H), -1 for no arrival."""

    @property
    def whole(self) -> int:
        missing = (request for request, arrivals in enumerate(self.arrival_ns) if arrivals[-1] < 0)
        return next(missing, len(self.arrival_ns))


class RobotTicks:
    """One robot that acts on chunks for ``ticks`` control ticks; `ControlLoop` steps it when a tick is due."""

    def __init__(
        self, mode: Mode, setting: ControlSetting, send: Send, ask: RequestChunk, ticks: int, phase_ns: int = 0
    ) -> None:
        """Begin the first tick ``phase_ns`` after the loop's start."""
        self.stepper, self._setting = mode.stepper(setting), setting
        self._weight = mode.weight
        self._blended: deque[Vector] = deque()
        self._send, self._ask = send, ask
        self._ticks = ticks
        self._phase_ns = phase_ns
        self._inbox: deque[tuple[int, int, int]] = deque()
        self._actions: dict[int, Sequence[Vector]] = {}
        self._executing = 0
        """The request whose chunk is executed; older chunks are dropped."""
        self._arrivals: dict[int, list[int]] = {}
        self._request_ticks: list[int] = []
        self._acts: list[tuple[int, int, int]] = []
        """Each tick's request and index, -1 for no action, and its lateness in ns."""
        self._busy: list[int] = []
        self._start_ns = 0
        self._tick = 0

    def begin(self, start_ns: int) -> int:
        """Return the time of the first tick of a loop that starts at ``start_ns``."""
        self._start_ns = start_ns + self._phase_ns
        return self._start_ns

    def step(self, begins_ns: int, clock: Clock) -> int | None:
        """Execute the tick that begins at ``begins_ns`` and return when the next one does; None after the last."""
        woke_ns, tick, floor = clock.now_ns(), self._tick, self._setting.rounding == "floor"
        if floor and tick:
            self._deliver(begins_ns, tick - 1)
            self._act(tick - 1, begins_ns, clock)
        if tick < self._ticks:
            self._deliver(begins_ns + 1, tick)  # what arrives just as a tick begins is known in it
            if self.stepper.ask(tick):
                self._request_ticks.append(tick)
                self._ask(len(self._request_ticks) - 1, tick)
            if not floor:
                self._deliver(begins_ns + 1, tick)
                self._act(tick, begins_ns, clock)
        self._busy.append(clock.now_ns() - woke_ns)
        self._tick += 1
        return begins_ns + self._setting.period_ns if self._tick < self._ticks + floor else None

    def arrived(self, request: int, actions: Sequence[Vector], at_ns: int) -> None:
        """Deliver, from any thread, the ``actions`` of a chunk that have arrived so far, of shape (D,) each.

        Actions that were delivered before are ignored.
        """
        arrivals = self._arrivals.setdefault(request, [])
        if len(actions) <= len(arrivals):
            return
        arrivals += [at_ns] * (len(actions) - len(arrivals))
        if request >= self._executing:
            self._actions[request] = actions
        self._inbox.append((at_ns, request, len(actions)))

    def finish(self) -> None:
        """Let the tick whose action is being sent be the last."""
        self._ticks = self._tick + (self._setting.rounding == "ceil")

    def acted(self) -> Acted:
        """Return the record so far; while the loop runs, that of the ticks that have ended."""
        # Copies, since the loop may append meanwhile.
        acts, horizon = np.array(self._acts[:], np.int64).reshape(-1, 3), self._setting.horizon
        request_tick = np.array(self._request_ticks[:], np.int64)
        arrival_ns = np.full((request_tick.size, horizon), -1)
        for request in range(request_tick.size):
            times = self._arrivals.get(request, ())[:horizon]
            began_ns = self._start_ns + self._request_ticks[request] * self._setting.period_ns
            arrival_ns[request, : len(times)] = np.array(times, np.int64) - began_ns
        chunk, index, late_ns = acts.T
        busy_ns = np.array(self._busy[: len(acts)], np.int64)
        return Acted(self._start_ns, chunk, index, late_ns, busy_ns, request_tick, arrival_ns)

    def _deliver(self, before_ns: int, tick: int) -> None:
        """Pass the stepper what had arrived before a time; the next call passes what was delivered late."""
        for _ in range(len(self._inbox)):  # those of now: other threads add to them
            at_ns, request, count = self._inbox.popleft()
            if at_ns < before_ns:
                self.stepper.arrived(request, count, tick)
                if self._weight < 1:
                    self._blend(self._actions[request])
            else:
                self._inbox.append((at_ns, request, count))

    def _blend(self, actions: Sequence[Vector]) -> None:
        due = actions[self.stepper.past :]
        weight, left = self._weight, self._blended
        self._blended = deque(
            weight * new + (1 - weight) * left[index] if index < len(left) else new for index, new in enumerate(due)
        )

    def _act(self, tick: int, due_ns: int, clock: Clock) -> None:
        action = self.stepper.act(tick)
        value = None
        if action is not None:
            value = self._blended.popleft() if self._weight < 1 else self._actions[action.request][action.index]
            while self._executing < action.request:
                self._actions.pop(self._executing, None)
                self._executing += 1
        self._send(value, due_ns)
        request, index = (-1, -1) if action is None else (action.request, action.index)
        self._acts.append((request, index, clock.now_ns() - due_ns))


class ControlLoop:
    """One thread that steps robots, each when its tick is due."""

    def __init__(self, robots: Sequence[RobotTicks], clock: Clock | None = None) -> None:
        self._robots = robots
        self._clock = clock or SystemClock()
        self._start_ns = 0
        self._stopped = False
        self._failure: BaseException | None = None
        self._thread = Thread(target=self._guarded, name="control", daemon=True)

    def start(self, start_ns: int | None = None) -> None:
        """Start at a time of the clock; None: in `HEAD_START_NS`."""
        self._start_ns = self._clock.now_ns() + HEAD_START_NS if start_ns is None else start_ns
        self._thread.start()

    def stop(self) -> None:
        self._stopped = True

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the end and return whether it is reached; raises what the loop raised."""
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            return False
        if self._failure is not None:
            raise self._failure
        return True

    def run(self) -> None:
        due = [(robot.begin(self._start_ns), place) for place, robot in enumerate(self._robots)]
        heapq.heapify(due)
        while due:
            begins_ns, place = due[0]
            self._clock.sleep_until_ns(begins_ns)
            if self._stopped:
                return
            next_ns = self._robots[place].step(begins_ns, self._clock)
            if next_ns is None:
                heapq.heappop(due)
            else:
                heapq.heapreplace(due, (next_ns, place))

    def _guarded(self) -> None:
        gc.freeze()  # no garbage collection of existing objects between two ticks
        try:
            with quick_switching():
                self.run()
        except BaseException as error:  # noqa: BLE001 - `join` raises it again
            self._failure = error
        finally:
            gc.unfreeze()
