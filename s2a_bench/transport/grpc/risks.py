"""What lerobot's policy server does that is dangerous and slow, from a greeting: its method `Ready` would reset it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Final
from urllib.parse import SplitResult

from s2a_bench.machine.doctor import Finding
from s2a_bench.transport.risks import PATIENCE_S, no_key

PORT: Final = 8080
PREFACE: Final = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
"""The connection preface of HTTP/2 and an empty SETTINGS frame (RFC 9113, 3.4 and 6.5)."""
FRAME_HEADER: Final = 9
SETTINGS: Final = 4


def examine(address: SplitResult) -> Iterator[Finding]:
    """Find out whether the server speaks HTTP/2, as lerobot's does; no method is called."""
    with socket.create_connection((address.hostname or "", address.port or PORT), PATIENCE_S) as connection:
        connection.sendall(PREFACE)
        head = b""
        while len(head) < FRAME_HEADER and (received := connection.recv(FRAME_HEADER - len(head))):
            head += received
    if len(head) < FRAME_HEADER or head[3] != SETTINGS:
        yield Finding("server", "error", "the server does not speak gRPC", "name another scheme, or another port")
        return
    yield Finding(
        "pickle",
        "warning",
        "it speaks gRPC; if it is lerobot's policy server, it unpickles what any client sends: a client that reaches "
        "the port can run code there (CVE-2026-25874), and a malicious server can do the same to its clients",
        "let it listen on 127.0.0.1 alone, and reach it by ssh -L; s2a-bench reads its answers without unpickling them",
    )
    yield Finding(
        "sleep",
        "advice",
        "lerobot's policy server answers no sooner than 33 ms after a request, unless it was started otherwise",
        "start it with --inference_latency=0; runs warn where answers look like it (padded-answers)",
    )
    yield Finding(
        "filter",
        "advice",
        "lerobot's policy server drops, silently, an observation without must_go whose state is within 1.0 of the last "
        "one: a client that waits for the chunk gets an empty answer after 2 s",
        "set must_go on each observation, as s2a-bench does, or measure with a state that changes",
    )
    yield no_key(
        address,
        "any client of lerobot's policy server names the policy that it loads, and takes the observation of another",
        "let it listen on 127.0.0.1 alone, and one client at a time",
    )
