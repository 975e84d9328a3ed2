"""What processes use, as /proc says: memory now and at most, threads, open descriptors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class Usage:
    """Of a process and its children together."""

    rss_mib: float
    peak_mib: float
    """The most resident memory (VmHWM) since the start, or since `forget_peak`."""
    threads: int
    descriptors: int


def family(pid: int) -> Iterator[int]:
    """Yield a process and all its descendants that run."""
    with suppress(OSError):
        tasks = [*(PROC / str(pid) / "task").iterdir()]
        yield pid
        for task in tasks:
            with suppress(OSError):
                for child in (task / "children").read_text().split():
                    yield from family(int(child))


def usage(pid: int) -> Usage:
    """Return what a process and its descendants use."""
    rss, peak, threads, descriptors = 0, 0, 0, 0
    for member in family(pid):
        with suppress(OSError):  # it has just ended
            lines = (PROC / str(member) / "status").read_text().splitlines()
            said = {
                name: value.split()[0] for name, _, value in (line.partition(":\t") for line in lines) if value.strip()
            }
            rss += int(said.get("VmRSS", 0))
            peak += int(said.get("VmHWM", 0))
            threads += int(said["Threads"])
            descriptors += len([*(PROC / str(member) / "fd").iterdir()])
    return Usage(rss / 1024, peak / 1024, threads, descriptors)


def forget_peak(pid: int) -> None:
    """Let the peak begin anew (proc(5), clear_refs), where that is allowed."""
    for member in family(pid):
        with suppress(OSError):
            (PROC / str(member) / "clear_refs").write_text("5")
