"""The run of `watch`: exchanges become rows as they end, on this thread alone, until the time, the count or Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from queue import Empty, Full, Queue
from threading import Thread
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from s2a_bench.clock import now_ns
from s2a_bench.errors import TransportError
from s2a_bench.machine import environment
from s2a_bench.machine.tuning import keep_large_blocks
from s2a_bench.plugins.watch.live import LastMinute
from s2a_bench.plugins.watch.relay import ByteRelay
from s2a_bench.plugins.watch.rows import EXCHANGES, STAGES, SeenCycles, sample_of, tokens_of
from s2a_bench.plugins.watch.shapes import described
from s2a_bench.progress import watching
from s2a_bench.provenance import AT_TAP, UNKNOWN, Origins, Provenance
from s2a_bench.store.requests import TOKENS, samples_table
from s2a_bench.store.run import RunWriter
from s2a_bench.transport.listening import in_url
from s2a_bench.transport.risks import is_local
from s2a_bench.transport.tap import Seen

if TYPE_CHECKING:
    from s2a_bench.plugins.watch.config import WatchOptions, WatchTap
    from s2a_bench.progress import Progress

POLL_S: Final = 0.1
MOST_REPORTED: Final = 10_000
"""Exchanges that wait to be written."""
SWITCH_S: Final = 5e-5
"""The longest time for which a thread that reads, or writes rows, keeps others from passing on; Python's is 5 ms."""


@dataclass(slots=True)
class Watch:
    """A run that keeps what is reported: `report` may be called from any thread, all else on the main one."""

    config: WatchOptions
    writer: RunWriter
    progress: Progress
    transport: str = ""
    view: LastMinute = field(default_factory=LastMinute)
    lost: int = 0
    """Exchanges that came faster than rows can be written."""
    _reported: Queue[tuple[int, Seen]] = field(default_factory=lambda: Queue(MOST_REPORTED))
    _cycles: SeenCycles = field(default_factory=SeenCycles)
    _kept: int = 0

    def __post_init__(self) -> None:
        self._cycles.tick_ns = 1e9 / self.config.control_hz if self.config.control_hz else 0.0

    @property
    def _full(self) -> bool:
        return self._kept >= self.config.requests > 0

    def report(self, client: int, seen: Seen) -> None:
        try:
            self._reported.put_nowait((client, seen))
        except Full:
            self.lost += 1

    def keep_until_done(self) -> None:
        """Write rows as exchanges end, until the time, the count or Ctrl-C."""
        self.progress.stage("watching; Ctrl-C ends it")
        ends_ns = now_ns() + round(self.config.seconds * 1e9)
        with suppress(KeyboardInterrupt), watching(self.progress, self.view):
            while not (self._full or (self.config.seconds and now_ns() >= ends_ns)):
                with suppress(Empty):
                    self._keep(*self._reported.get(timeout=POLL_S))

    def keep_rest(self) -> int:
        """Write the exchanges reported since, and return how many there were in all."""
        while not (self._reported.empty() or self._full):
            self._keep(*self._reported.get())
        return self._kept

    def _keep(self, client: int, seen: Seen) -> None:
        number, row = self._kept, self._cycles.row(client, seen)
        self._kept += 1
        self.writer.append(EXCHANGES, [row])
        self.writer.sample(sample_of(row, seen, number, self.transport))
        self.writer.tokens(tokens_of(row, seen, number))
        self.view.rows.append(row)
        if seen.observation is not None:
            with suppress(RecursionError):  # it may be nested too deep to be described
                self.view.sends[row.cell] = described(seen.observation)
                self.writer.update(sends=dict(self.view.sends))


@contextmanager
def opened(
    config: WatchOptions, output: Path, progress: Progress, transport: str, origin: Provenance
) -> Iterator[Watch]:
    """Open the run folder of a watch."""
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "stages": STAGES,
        "provenance": Origins(origin).to_manifest(),
    }
    with RunWriter.create(output, "watch", manifest, (EXCHANGES, samples_table(STAGES), TOKENS)) as writer:
        progress.opened(writer.path)
        yield Watch(config, writer, progress, transport)


def run_tap(config: WatchTap, output: Path, progress: Progress) -> Path:
    """Relay until the end and return the run folder; raises S2AError, also if no exchange was seen."""
    transport = config.transport
    transport.check_machine()
    reader = resolve_name(transport.reader)
    origin = Provenance(tokens=AT_TAP, link="real" if is_local(config.server[0]) else UNKNOWN)
    with config.bound() as listener, opened(config, output, progress, transport.name, origin) as watch:
        relay = ByteRelay(listener, config.server, reader, watch.report, progress.say)
        host, port = listener.getsockname()[:2]
        at = f"{urlsplit(config.to).scheme}://{in_url(host)}:{port}"
        progress.say(f"listening at {at}: let the robot connect there instead of to {config.to}")
        with _served(relay):
            watch.keep_until_done()
        exchanges, totals = watch.keep_rest(), relay.totals
        watch.writer.update(tap={**asdict(totals), "lost": watch.lost})
        if not exchanges:
            raise TransportError(
                f"no exchange was seen over {totals.connections} connections; let the robot connect to {at}"
            )
        return watch.writer.path


@contextmanager
def _served(relay: ByteRelay) -> Iterator[None]:
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    keep_large_blocks()
    serving = Thread(target=relay.serve, name="relay", daemon=True)
    serving.start()
    try:
        yield
    finally:
        relay.stop()
        serving.join()
        sys.setswitchinterval(before_s)
