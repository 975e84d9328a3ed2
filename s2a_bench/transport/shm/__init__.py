"""The floor of a wire between two processes of one machine: shared memory, and a packet that says where to look."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.options import option
from s2a_bench.transport import ACTIONS, SERVER, TOKENS, Transport, TransportOptions, Wiring


class ShmOptions(TransportOptions):
    socket: str = option(
        "", "path of the Unix socket where shared memory is handed over [default: a new one of this user]", side=SERVER
    )


class Shm(Transport[ShmOptions]):
    """Request, picture and tokens lie in shared memory; nothing but their places goes through the kernel."""

    name = "shm"
    options = ShmOptions
    payloads = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
    answer_kinds = (TOKENS, ACTIONS)
    accepts_state = True
    stages: ClassVar[Mapping[str, str]] = {"header_pack": "pack", "header_parse": "parse"}
    facts = (PAYLOAD_BYTES,)
    order = 90
    crosses_links = False
    style: ClassVar[Mapping[str, tuple[str, str]]] = {"": ("#6A3D9A", "--")}
    checks: ClassVar[Mapping[str, str]] = {"shared-memory": "s2a_bench.transport.shm:shared_memory"}
    client_class = "s2a_bench.transport.shm.client:ShmClient"
    server_class = "s2a_bench.transport.shm.server:ShmServer"

    def check_machine(self) -> None:
        if why := unavailable():
            raise UsageError(f"`transport` shm: {why}; take another")

    def addresses(self, options: ShmOptions) -> Iterable[str]:
        return options.socket, ""

    def ready(self, wiring: Wiring[ShmOptions]) -> str:
        return f"serving shared memory at {wiring.address} for this user alone"


def unavailable() -> str:
    """Return why memory without a name cannot be had or handed over here, or nothing."""
    there = hasattr(os, "memfd_create")
    return "" if there else f"it needs Linux (memfd_create); this is {sys.platform}"


def shared_memory(machine: Machine) -> Finding | None:  # noqa: ARG001 - the system of this process
    """Return what the doctor finds: that such memory cannot be had here, as a sandbox may forbid it."""
    why = unavailable()
    if not why:
        try:
            os.close(os.memfd_create("s2a_bench", os.MFD_CLOEXEC))
        except OSError as error:
            why = f"memfd_create: {error.strerror}"
    return Finding("shared-memory", "advice", f"--transport shm cannot run: {why}", "leave it out") if why else None


SHM = Shm()
