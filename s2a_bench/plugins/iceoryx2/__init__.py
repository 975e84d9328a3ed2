"""Zero copy between two processes of one machine: pictures are written into memory where iceoryx2's peer reads them."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from typing import ClassVar

from s2a_bench.extras import how_to_install
from s2a_bench.facts import PAYLOAD_BYTES
from s2a_bench.machine.doctor import Finding, Machine
from s2a_bench.options import option
from s2a_bench.transport import ACTIONS, SERVER, TOKENS, Transport, TransportOptions, Wiring

EXTRA = "zero copy with iceoryx2"


class Iceoryx2Options(TransportOptions):
    service: str = option(
        "",
        "iceoryx2: name of the server's service [default: a new one]",
        side=SERVER,
        pattern=r"^[A-Za-z0-9_./-]{0,80}$",
    )


class Iceoryx2(Transport[Iceoryx2Options]):
    """Requests with their pictures, and pieces of answers, lie in slices of shared memory that iceoryx2 lends."""

    name = "iceoryx2"
    options = Iceoryx2Options
    payloads = ("raw", "yuyv", "jpeg", "jpeg-preencoded", "png")
    answer_kinds = (TOKENS, ACTIONS)
    accepts_state = True
    stages: ClassVar[Mapping[str, str]] = {"header_pack": "pack", "header_parse": "parse"}
    facts = (PAYLOAD_BYTES,)
    order = 90
    crosses_links = False
    style: ClassVar[Mapping[str, tuple[str, str]]] = {"": ("#6A3D9A", "--")}
    needs = ("iceoryx2", "iceoryx2")
    packages = ("iceoryx2",)
    checks: ClassVar[Mapping[str, str]] = {"iceoryx2": "s2a_bench.plugins.iceoryx2:check"}
    client_class = "s2a_bench.plugins.iceoryx2.client:Iceoryx2Client"
    server_class = "s2a_bench.plugins.iceoryx2.server:Iceoryx2Server"

    def addresses(self, options: Iceoryx2Options) -> Iterable[str]:
        return options.service, ""

    def ready(self, wiring: Wiring[Iceoryx2Options]) -> str:
        return f"serving iceoryx2 at {wiring.address} for this user alone"


def check(machine: Machine) -> Finding:
    """Return whether zero copy can be measured here, and what can be measured instead."""
    if machine.finds("iceoryx2"):
        return Finding("iceoryx2", "state", "installed: --transport iceoryx2 measures zero copy")
    cure = how_to_install("iceoryx2")
    if platform.machine() != "x86_64":
        cure = "pip install iceoryx2 builds it with Rust's toolchain, https://rustup.rs; else loopback is the floor"
    return Finding("iceoryx2", "state", "not installed", cure)


ICEORYX2 = Iceoryx2()
