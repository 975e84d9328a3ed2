"""The rows of what was read beside a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from s2a_bench.facts import Fact
from s2a_bench.store.schema import Table


@dataclass(frozen=True, slots=True)
class ResourceRow:
    """One reading of one reader; ``cost_ns`` is how long reading took, ``at_ns`` (CLOCK_MONOTONIC) its middle.

    Columns whose names end in ``_cpu_ns`` or ``_energy_j`` count up from some moment; the others hold for the moment.
    ``client`` is the harness, ``server`` all servers together; ``*_busy`` are shares from 0 to 1.
    """

    at_ns: int
    reader: str
    cost_ns: int
    client_cpu_ns: int | None = None
    server_cpu_ns: int | None = None
    client_rss_bytes: int | None = None
    server_rss_bytes: int | None = None
    memory_available_bytes: int | None = None
    cpu_busy: float | None = None
    package_energy_j: float | None = None
    gpu_busy: float | None = None
    gpu_memory_bytes: int | None = None
    gpu_power_w: float | None = None
    gpu_energy_j: float | None = None
    gpu_temperature_c: float | None = None
    gpu_clock_hz: float | None = None
    board_power_w: float | None = None


RESOURCES: Final[Table[ResourceRow]] = Table("resources", ResourceRow)
"""One row a reading beside the run."""


BOARD_ENERGY_J = Fact("board_energy_j", "J", "energy at the board's input")
ENERGY_J = Fact("energy_j", "J", "energy of the board, else of the GPUs and CPU packages that can be read")
POWER_W = Fact("power_w", "W", "`energy_j` over the time of the request")
SPENT: Final = (
    Fact("client_cpu_ns", "ns", "CPU time of the harness"),
    Fact("server_cpu_ns", "ns", "CPU time of all servers of ours"),
    Fact("client_rss_bytes", "bytes", "memory of the harness, largest value"),
    Fact("server_rss_bytes", "bytes", "memory of all servers of ours, largest value"),
    Fact("memory_available_bytes", "bytes", "memory that the machine has left, mean"),
    Fact("cpu_busy", "", "busy share of all CPUs, mean"),
    Fact("package_energy_j", "J", "energy of the CPU packages"),
    Fact("gpu_busy", "", "busy share of the GPUs, mean"),
    Fact("gpu_memory_bytes", "bytes", "memory in use on the GPUs, largest value"),
    Fact("gpu_power_w", "W", "power of the GPUs, mean"),
    Fact("gpu_energy_j", "J", "energy of the GPUs"),
    Fact("gpu_temperature_c", "°C", "temperature of the GPUs, largest value"),
    Fact("gpu_clock_hz", "Hz", "clock of the GPUs, mean"),
    Fact("board_power_w", "W", "power at the board's input, mean"),
    *(BOARD_ENERGY_J, ENERGY_J, POWER_W),
)
"""The facts of a request that are read beside it, under the columns' names."""
