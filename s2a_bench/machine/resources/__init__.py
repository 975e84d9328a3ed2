"""Resources of a run besides time: CPU, memory, GPU and power, read while it measures.

A `Reader` reads one source; the sources of this machine are opened, the others are listed with the reason. The
`ResourceSampler` (`resources.sampler`) polls them and summarises the time between two moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Annotated, Final, Protocol, get_args, get_origin, get_type_hints

from s2a_bench.errors import S2AError
from s2a_bench.facts import Fact
from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class ResourceRow:
    """One reading of one reader; ``cost_ns`` is the time that reading took, ``at_ns`` (CLOCK_MONOTONIC) its middle.

    The others have the unit and the meaning of the fact of that name. Those whose names end in ``_cpu_ns`` or
    ``_energy_j`` are counters, the rest values of the moment; ``*_busy`` are shares from 0 to 1.
    """

    at_ns: int
    reader: str
    cost_ns: int
    client_cpu_ns: Annotated[int | None, "ns", "CPU time of the harness"] = None
    server_cpu_ns: Annotated[int | None, "ns", "CPU time of all servers of ours"] = None
    client_rss_bytes: Annotated[int | None, "bytes", "memory of the harness, largest value"] = None
    server_rss_bytes: Annotated[int | None, "bytes", "memory of all servers of ours, largest value"] = None
    memory_available_bytes: Annotated[int | None, "bytes", "memory that the machine has left, mean"] = None
    cpu_busy: Annotated[float | None, "", "busy share of all CPUs, mean"] = None
    package_energy_j: Annotated[float | None, "J", "energy of the CPU packages"] = None
    gpu_busy: Annotated[float | None, "", "busy share of the GPUs, mean"] = None
    gpu_memory_bytes: Annotated[int | None, "bytes", "memory in use on the GPUs, largest value"] = None
    gpu_power_w: Annotated[float | None, "W", "power of the GPUs, mean"] = None
    gpu_energy_j: Annotated[float | None, "J", "energy of the GPUs"] = None
    gpu_temperature_c: Annotated[float | None, "°C", "temperature of the GPUs, largest value"] = None
    gpu_clock_hz: Annotated[float | None, "Hz", "clock of the GPUs, mean"] = None
    board_power_w: Annotated[float | None, "W", "power at the board's input, mean"] = None


RESOURCES: Final[Table[ResourceRow]] = Table("resources", ResourceRow)

BOARD_ENERGY_J = Fact("board_energy_j", "J", "energy at the board's input")
ENERGY_J = Fact("energy_j", "J", "energy of the board, else of the GPUs and CPU packages that can be read")
POWER_W = Fact("power_w", "W", "`energy_j` over the time of the request")
_COLUMNS = get_type_hints(ResourceRow, include_extras=True).items()
SPENT: Final = (
    *(Fact(name, *get_args(hint)[1:]) for name, hint in _COLUMNS if get_origin(hint) is Annotated),
    *(BOARD_ENERGY_J, ENERGY_J, POWER_W),
)
"""The facts of a request from the readers, by the names of the columns."""


class Unreadable(S2AError):
    """This machine does not have a reader's source, or gives no permission to read it."""


class Reader(Protocol):
    """Reads one source. Built as ``Class(pids)`` with the servers' process ids; raises Unreadable."""

    about: str
    cheap: bool = False
    """True if a reading takes microseconds, so that it is taken before and after every request."""

    def read(self) -> Mapping[str, float]:
        """Return columns of `ResourceRow` by name; an unreadable one is absent."""

    def close(self) -> None:
        """Close the source, if it is one to be closed; may be called twice."""


READERS: dict[str, str] = {
    "cpu": "s2a_bench.machine.resources.host:CpuTimes",
    "memory": "s2a_bench.machine.resources.host:HostMemory",
    "rapl": "s2a_bench.machine.resources.host:Rapl",
    "nvml": "s2a_bench.machine.resources.nvidia:Nvml",
    "tegrastats": "s2a_bench.machine.resources.nvidia:Tegrastats",
}
"""Name -> class, in the order of opening."""


def open_readers(pids: Sequence[int]) -> tuple[dict[str, Reader], dict[str, str]]:
    """Open the readers of this machine, by name; also return the reason for each one left out."""
    readers: dict[str, Reader] = {}
    left_out: dict[str, str] = {}
    for name, where in READERS.items():
        try:
            readers[name] = resolve_name(where)(pids)
        except Unreadable as reason:
            left_out[name] = str(reason)
    return readers, left_out
