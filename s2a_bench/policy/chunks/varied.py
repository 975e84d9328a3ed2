"""Queue with a trigger of its own for every request: what a rule that learns makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from s2a_bench.policy.chunks.append import QueueStepper, length_of
from s2a_bench.policy.chunks.cycles import Laid, assemble

if TYPE_CHECKING:
    from s2a_bench.policy.chunks import ChunkStepper, Cycles, Ints, Setting


@dataclass(frozen=True, slots=True)
class Varied(Laid):
    """Ask for chunk r when ``triggers[r]`` actions are left, the last one ever after, and append; ``execute`` is s."""

    name: ClassVar[str] = "queue"

    triggers: tuple[int, ...]
    execute: int = 0

    def stepper(self, setting: Setting) -> ChunkStepper:
        """Follow one robot."""
        return VariedStepper(self.triggers[0], length_of(self.execute, setting), triggers=self.triggers)

    def cycles(self, latency_ns: Ints, setting: Setting) -> Cycles:
        """Say what becomes of requests with latencies of shape (R,), in ns: as `Queue`, one request at a time."""
        delay, known = setting.delay_ticks(latency_ns), setting.known_ticks(latency_ns)
        length, last = length_of(self.execute, setting), len(self.triggers) - 1
        leaves, starts, left = [0], [], 0
        for request, (ticks, here) in enumerate(zip(delay.tolist(), known.tolist(), strict=True)):
            now = leaves[-1]
            starts.append(now + max(left, ticks))
            end = starts[-1] + length
            leaves.append(max(end - self.triggers[min(request + 1, last)], now + max(here, 1)))
            left = max(0, end - leaves[-1])
        asked, start = np.array(leaves[:-1], np.int64), np.array(starts, np.int64)
        first, until = np.zeros_like(start), start + length
        return assemble(asked, asked + delay, start, first, until, ticks=leaves[-1], horizon=setting.horizon)


@dataclass(slots=True)
class VariedStepper(QueueStepper):
    """A queue whose trigger is another one for every request."""

    triggers: tuple[int, ...] = (0,)

    def ask(self, tick: int) -> bool:
        """Ask when as few actions are left as this request wants."""
        self.trigger = self.triggers[min(self.asked, len(self.triggers) - 1)]
        return QueueStepper.ask(self, tick)
