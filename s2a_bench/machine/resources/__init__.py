"""What a run costs the machine beside time: CPU, memory, GPU and power, read while it goes on.

A Reader reads one source; those that this machine has are opened, the others are named with the reason. The Sampler
(`resources.sampler`) polls them and answers what happened between two moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import Protocol

from s2a_bench.errors import S2AError


class Unreadable(S2AError):
    """This machine does not have a reader's source, or does not let us read it."""


class Reader(Protocol):
    """Reads one source. Built as ``Class(pids)`` with the servers' process ids; raises Unreadable."""

    about: str
    """What is read, for the manifest: a device's name, or a program's."""
    cheap: bool
    """Whether a reading takes microseconds, so that it may be taken before and after every request."""

    def read(self) -> Mapping[str, float]:
        """Return columns of `ResourceRow` by name; what cannot be read at the moment is absent."""
        ...

    def close(self) -> None:
        """Let go of the source; may be called twice."""
        ...


READERS: dict[str, str] = {
    "cpu": "s2a_bench.machine.resources.host:CpuTimes",
    "memory": "s2a_bench.machine.resources.host:Memory",
    "rapl": "s2a_bench.machine.resources.rapl:Rapl",
    "nvml": "s2a_bench.machine.resources.nvidia:Nvml",
    "jtop": "s2a_bench.machine.resources.jetson:Jtop",
    "tegrastats": "s2a_bench.machine.resources.jetson:Tegrastats",
}
"""Name -> class, in the order in which they are tried."""
INSTEAD = {"tegrastats": "jtop"}
"""A reader that is left out where another one, which reads the same sensors, could be opened."""


def open_readers(pids: Sequence[int]) -> tuple[dict[str, Reader], dict[str, str]]:
    """Open what this machine has: readers by name, and the reason for each one left out."""
    readers: dict[str, Reader] = {}
    left_out: dict[str, str] = {}
    for name, where in READERS.items():
        if INSTEAD.get(name) in readers:
            left_out[name] = f"{INSTEAD[name]} is used"
            continue
        try:
            readers[name] = resolve_name(where)(pids)
        except Unreadable as reason:
            left_out[name] = str(reason)
    return readers, left_out
