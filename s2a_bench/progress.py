"""How a run tells what it is doing."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol


class Progress(Protocol):
    """How a run tells what it is doing."""

    def opened(self, folder: Path) -> None:
        """Say where the results go, before the first of them."""
        ...

    def stage(self, text: str) -> None:
        """Say what is being done now."""
        ...

    def expect(self, samples: int) -> None:
        """Say how many samples are to come."""
        ...

    def advance(self) -> None:
        """Say that one more sample is done."""
        ...


class NullProgress:
    """Shows nothing, and keeps what it was told last."""

    folder: Path | None = None
    text = ""
    expected = done = 0

    def opened(self, folder: Path) -> None:
        """Keep the folder."""
        self.folder = folder

    def stage(self, text: str) -> None:
        """Keep the text."""
        self.text = text

    def expect(self, samples: int) -> None:
        """Keep the number."""
        self.expected = samples

    def advance(self) -> None:
        """Count."""
        self.done += 1
