"""`doctor --url`: what a server that somebody else runs does that is dangerous, without asking it to do anything.

Each transport that has URLs examines what answers there (`Urls.examine`); what all of them share is here, and
gRPC, of which there is no transport: lerobot's policy server speaks it.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from ipaddress import ip_address
from pkgutil import resolve_name
from typing import Final, TypeAlias
from urllib.parse import SplitResult, urlsplit

from s2a_bench.errors import TransportError, UsageError
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport import TRANSPORTS

Examine: TypeAlias = Callable[[SplitResult], Iterator[Finding]]
"""Yields findings about the server at a URL that names a host; raises OSError or TransportError where none answers."""

PATIENCE_S: Final = 5.0
GRPC: Final = "grpc"
GRPC_PORT: Final = 8080
"""Where lerobot's policy server listens unless told."""
PREFACE: Final = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
"""With which a client of HTTP/2 begins, and an empty SETTINGS frame (RFC 9113, 3.4 and 6.5)."""
FRAME_HEADER: Final = 9
SETTINGS: Final = 4
ENCRYPTED: Final = frozenset({"https", "wss"})


def examine(url: str) -> list[Finding]:
    """Return what is found at a URL; raises UsageError for one of no known kind."""
    known = {
        scheme: each.urls.examine
        for _, each in TRANSPORTS.loaded()
        for scheme in each.urls.schemes
        if each.urls.examine
    }
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise UsageError(f"`url`: that is no URL: {error}") from error
    if not host or parts.scheme not in {*known, GRPC}:
        schemes = ", ".join(f"{scheme}://" for scheme in (*known, GRPC))
        said = f"{parts.scheme}://{host or ''}" if parts.scheme else url.rpartition("@")[2]
        raise UsageError(
            f"`url`: '{said}' should look like http://192.168.0.5:8000: one of {schemes}, a host, and its port"
        )
    own: Examine = grpc if parts.scheme == GRPC else resolve_name(known[parts.scheme])
    findings = [plain_text(parts)]
    try:
        findings += own(parts)
    except (OSError, TransportError) as error:
        findings.append(
            Finding("server", "error", f"{host} does not answer: {printable(str(error))}", "start it, or name another")
        )
    return findings


def printable(text: str, most: int = 120) -> str:
    """Return what a server said as one short line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:most])


def is_local(host: str) -> bool:
    """Whether a name means this machine alone."""
    with suppress(OSError, ValueError):
        return all(ip_address(found[4][0]).is_loopback for found in socket.getaddrinfo(host, None))
    return False


def plain_text(parts: SplitResult) -> Finding:
    """Say whether pictures, keys and actions can be read and changed on their way."""
    host, port = parts.hostname or "", parts.port or "PORT"
    if parts.scheme in ENCRYPTED:
        return Finding("plain-text", "state", f"what travels to {host} is encrypted")
    if is_local(host):
        return Finding("plain-text", "state", f"{host} is this machine: nothing leaves it")
    return Finding(
        "plain-text",
        "warning",
        f"all travels to {host} in plain text: who is on the way reads pictures and keys, and changes actions",
        f"ssh -L {port}:127.0.0.1:{port} {host}, and then 127.0.0.1 in the URL",
    )


def no_key(parts: SplitResult, what: str, cure: str) -> Finding:
    """Say that a server asks for no key: on this machine that is a choice, off it whoever reaches it uses it."""
    here = is_local(parts.hostname or "")
    return Finding("no-key", "advice" if here else "warning", f"it wants no key: {what}", cure)


def grpc(parts: SplitResult) -> Iterator[Finding]:
    """Tell whether HTTP/2 answers, and what that means if it is lerobot's; no method is called, as `Ready` resets."""
    with socket.create_connection((parts.hostname or "", parts.port or GRPC_PORT), PATIENCE_S) as connection:
        connection.sendall(PREFACE)
        head = b""
        while len(head) < FRAME_HEADER and (piece := connection.recv(FRAME_HEADER - len(head))):
            head += piece
    if len(head) < FRAME_HEADER or head[3] != SETTINGS:
        yield Finding("server", "error", "what answers does not speak gRPC", "name another scheme, or another port")
        return
    yield Finding(
        "pickle",
        "warning",
        "it speaks gRPC; if it is lerobot's policy server, it unpickles what anybody sends, and who reaches the port "
        "runs code there (CVE-2026-25874); a malicious one does the same to its clients",
        "let it listen on 127.0.0.1 alone, and reach it by ssh -L; s2a-bench does not speak to it",
    )
