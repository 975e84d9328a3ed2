"""The rows of what was read beside a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

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
