"""The floor of a wire between two processes of one machine: shared memory, and a packet that says where to look."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.options import option
from s2a_bench.transport import Client, Handler, Server, Transport, Wiring
from s2a_bench.transport.options import SERVER, Options


class ShmOptions(Options):
    """The options of `shm`."""

    socket: str = option(
        "", "path of the Unix socket where shared memory is handed over [default: a new one of this user]", side=SERVER
    )


class Shm(Transport[ShmOptions]):
    """Request, picture and tokens lie in shared memory; nothing but their places goes through the kernel."""

    name = "shm"
    for_policies = True
    options = ShmOptions
    payloads = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
    stages: ClassVar[Mapping[str, str]] = {"header_pack": "pack", "header_parse": "parse"}
    tells = (PAYLOAD_BYTES,)
    order = 90
    looks: ClassVar[Mapping[str, tuple[str, str]]] = {"": ("#6A3D9A", "--")}
    checks: ClassVar[Mapping[str, str]] = {"shared-memory": "s2a_bench.transport.shm.checks:shared_memory"}

    def client(self, wiring: Wiring[ShmOptions], alive: Callable[[], bool]) -> Client:
        """Connect to the server at ``wiring.address``."""
        _check_system()
        from s2a_bench.transport.shm.client import ShmClient

        return ShmClient(wiring, alive)

    def server(self, wiring: Wiring[ShmOptions], handler: Handler) -> Server:
        """Bind a server."""
        _check_system()
        from s2a_bench.transport.shm.server import ShmServer

        return ShmServer(wiring, handler)

    def check(self, variant: str, options: ShmOptions, *, mode: str, engine: str) -> None:  # noqa: ARG002
        """Refuse systems without such memory."""
        _check_system()

    def bind(self, options: ShmOptions, taken: Sequence[str]) -> str:
        """Return the socket of a new server: the one that was asked for, a new one for a second server."""
        return "" if options.socket in taken else options.socket

    def ready(self, wiring: Wiring[ShmOptions], address: str) -> str:  # noqa: ARG002
        """Return where memory is handed over, and to whom."""
        return f"serving shared memory at {address} for this user alone"


def unavailable() -> str:
    """Return why memory without a name cannot be had or handed over here, or nothing."""
    there = hasattr(os, "memfd_create") and hasattr(socket, "SO_PEERCRED")
    return "" if there else f"it needs Linux (memfd_create, SO_PEERCRED); this is {sys.platform}"


def _check_system() -> None:
    if why := unavailable():
        raise UsageError(f"`transport` shm: {why}; take another")


SHM = Shm()
