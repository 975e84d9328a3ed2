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
