"""The mode `toy-mode`: a new chunk takes over from its first action on, and what is left of the old one is dropped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from s2a_bench.plugins.chunks.modes import ChunkAction, ChunkStepper, Mode, ControlSetting


@dataclass(frozen=True, slots=True)
class ToyMode(Mode):
    """Ask when ``trigger`` actions are left; rules may choose how many."""

    name: ClassVar[str] = "toy-mode"
    triggered: ClassVar[bool] = True

    trigger: int = 0

    def stepper(self, setting: ControlSetting) -> ChunkStepper:
        """Follow one robot."""
        return ToyChunks(setting.horizon, self.trigger)


@dataclass(slots=True)
class ToyChunks(ChunkStepper):
    """The newest chunk, and how many of its actions are done."""

    horizon: int
    trigger: int = 0
    newest: int = -1
    done: int = 0
    waits: bool = False

    def arrived(self, request: int, actions: int, tick: int) -> None:  # noqa: ARG002 - chunks arrive whole
        """Take over at once."""
        self.newest, self.done, self.waits = request, 0, False

    def ask(self, tick: int) -> bool:  # noqa: ARG002 - whenever few are left
        """Ask once few actions are left."""
        left = self.horizon - self.done if self.newest >= 0 else 0
        if self.waits or left > self.trigger:
            return False
        self.waits = True
        return True

    def act(self, tick: int) -> ChunkAction | None:  # noqa: ARG002 - whatever is next
        """Return the next action."""
        if self.newest < 0 or self.done == self.horizon:
            return None
        self.done += 1
        return ChunkAction(self.newest, self.done - 1)
