"""The progress of a run."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Protocol


class Progress(Protocol):
    def opened(self, folder: Path) -> None:
        """Show the run folder, before the first result."""

    def say(self, line: str) -> None:
        """Show one line that stays."""

    def stage(self, text: str) -> None:
        """Show the current stage."""

    def expect(self, samples: int) -> None:
        """Set the number of samples."""

    def advance(self) -> None:
        """Count one more sample."""


class NullProgress:
    """Shows nothing, and keeps the last values."""

    folder: Path | None = None
    text = ""
    expected = done = 0

    def opened(self, folder: Path) -> None:
        self.folder = folder

    def say(self, line: str) -> None: ...

    def stage(self, text: str) -> None:
        self.text = text

    def expect(self, samples: int) -> None:
        self.expected = samples

    def advance(self) -> None:
        self.done += 1


class LiveView(Protocol):
    def draw(self, width: int) -> Any:
        """Return the present view as a renderable of rich, ``width`` columns wide."""

    def lines(self) -> Iterable[str]:
        """Return the result as text, for an output without a terminal."""


def watching(progress: Progress, view: LiveView) -> AbstractContextManager[None]:
    """Show a view within the context, if ``progress`` has a method ``watch``."""
    watch = getattr(progress, "watch", None)
    shown: AbstractContextManager[None] = watch(view) if watch else nullcontext()
    return shown
