"""Progress of a run: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from s2a_bench.cli.output import print_line, shown
from s2a_bench.clock import now_ns
from s2a_bench.progress import LiveView

REFRESHES_HZ = 8
PLAIN_STEPS = 5
"""Lines of progress that a run prints without a terminal."""


class RunProgress:
    """Progress of one run on standard error, as a context manager."""

    def __init__(self, unit: str = "samples") -> None:
        self._unit = unit
        self.console = Console(stderr=True)
        self.folder: Path | None = None
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=None)
        self._started_ns = now_ns()
        self._stage = ""

    def __enter__(self) -> RunProgress:  # noqa: PYI034 - Self is typing's since 3.11
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, line: str) -> None:
        print_line(line, self.console)

    @contextmanager
    def watch(self, picture: LiveView) -> Iterator[None]:
        """Show a live view while the context lasts; its last state stays on the terminal."""
        if not self.console.is_terminal:
            yield
            for line in picture.lines():
                self.say(line)
            return
        self._bar.stop()  # one live display at a time
        try:
            with Live(
                get_renderable=lambda: picture.draw(self.console.width),
                console=self.console,
                refresh_per_second=REFRESHES_HZ,
            ):
                yield
        finally:
            self._bar.start()

    def opened(self, folder: Path) -> None:
        self.folder = folder

    def stage(self, text: str) -> None:
        self._bar.update(self._task, description=escape(shown(text)))
        if self._bar.disable and text != self._stage:
            self.say(text)
        self._stage = text

    def expect(self, samples: int) -> None:
        self._started_ns = now_ns()
        self._bar.update(self._task, total=samples)

    def advance(self) -> None:
        self._bar.advance(self._task)
        done, total = (int(count or 0) for count in (self._bar.tasks[0].completed, self._bar.tasks[0].total))
        if self._bar.disable and done % max(1, total // PLAIN_STEPS) == 0:
            left_s = (now_ns() - self._started_ns) / 1e9 / done * (total - done)
            self.say(f"  {done} of {total} {self._unit}, about {left_s:.0f} s left")
