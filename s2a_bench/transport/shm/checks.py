"""What the doctor checks for shared memory."""

from __future__ import annotations

import os

from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.transport.shm import unavailable


def shared_memory(machine: Machine) -> Finding | None:  # noqa: ARG001 - the system of this process
    """Return that memory without a name cannot be had here, if so: a sandbox may forbid it."""
    why = unavailable()
    if not why:
        try:
            os.close(os.memfd_create("s2a_bench", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING))
        except OSError as error:
            why = f"memfd_create: {error.strerror}"
    return Finding("shared-memory", "advice", f"--transport shm cannot run: {why}", "leave it out") if why else None
