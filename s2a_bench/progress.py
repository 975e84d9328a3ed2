"""How a run tells what it is doing."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Protocol


class Progress(Protocol):
    """How a run tells what it is doing."""

    def opened(self, folder: Path) -> None:
        """Say where the results go, before the first of them."""

    def say(self, line: str) -> None:
        """Say one line that stays."""

    def stage(self, text: str) -> None:
        """Say what is being done now."""

    def expect(self, samples: int) -> None:
        """Say how many samples are to come."""

    def advance(self) -> None:
        """Say that one more sample is done."""


class NullProgress:
    """Shows nothing, and keeps what it was told last."""

    folder: Path | None = None
    text = ""
    expected = done = 0

    def opened(self, folder: Path) -> None:
        self.folder = folder

    def say(self, line: str) -> None:
        """Say nothing."""

    def stage(self, text: str) -> None:
        self.text = text

    def expect(self, samples: int) -> None:
        self.expected = samples

    def advance(self) -> None:
        self.done += 1


class LiveView(Protocol):
    """What can be watched while it happens."""

    def draw(self, width: int) -> Any:
        """Return how it looks now, so many columns wide, as rich renders it."""

    def lines(self) -> Iterable[str]:
        """Return what came of it, for where there is no terminal."""


def watching(progress: Progress, picture: LiveView) -> AbstractContextManager[None]:
    """Show a picture for as long as the context lasts, where ``progress`` has a method ``watch`` for it."""
    watch = getattr(progress, "watch", None)
    shown: AbstractContextManager[None] = watch(picture) if watch else nullcontext()
    return shown
