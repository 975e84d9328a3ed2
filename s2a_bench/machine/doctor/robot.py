"""What the robot's side needs: sockets for DDS, and cameras."""

from __future__ import annotations

from s2a_bench.machine.doctor import Finding, Machine

RMEM_WANTED = 4 << 20
"""Bytes of receive buffer that hold a large picture's fragments while the reader is busy (docs/latency.md)."""


def rmem_max(machine: Machine) -> Finding | None:
    """See how large a socket's receive buffer may be; DDS asks for as much as it gets."""
    rmem = machine.number("proc/sys/net/core/rmem_max")
    if rmem is None:
        return None
    if rmem >= RMEM_WANTED:
        return Finding("rmem-max", "state", f"net.core.rmem_max is {rmem}")
    return Finding(
        "rmem-max",
        "warning",
        f"net.core.rmem_max is {rmem}: DDS loses fragments of large pictures and stalls by 200 ms",
        f"sudo sysctl -w net.core.rmem_max={RMEM_WANTED}",
    )


def cameras(machine: Machine) -> Finding:
    """List the cameras with their formats; the harness reads YUYV."""
    found = machine.cameras()
    if not found:
        return Finding("cameras", "state", "none; the synthetic source needs none")
    closed = [camera.path for camera in found if camera.problem]
    if closed:
        told = "; ".join(f"{camera.path}: {camera.problem}" for camera in found if camera.problem)
        return Finding("cameras", "warning", told, "sudo usermod -aG video $USER, and log in again")
    told = "; ".join(f"{camera.path} {camera.card}: {camera.summary()}" for camera in found)
    if not any("YUYV" in camera.formats for camera in found):
        return Finding(
            "cameras", "advice", f"{told}; none offers YUYV", "use a USB camera that does, or --source bag:FILE"
        )
    return Finding("cameras", "state", told)
