"""`doctor --url`: security risks of an external server, found without a request to its model.

Each transport with URLs has its own examination (`Urls.examine`). This module has the findings that all share.
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
"""Yields findings about the server at a URL with a host; raises OSError or TransportError if none answers."""

PATIENCE_S: Final = 5.0
ENCRYPTED: Final = frozenset({"https", "wss"})


def examine(url: str) -> list[Finding]:
    """Return the findings about a URL; raises UsageError for an unknown scheme."""
    known = {
        scheme: each.urls.examine
        for _, each in TRANSPORTS.loaded()
        for scheme in each.urls.schemes
        if each.urls.examine
    }
    try:
        address = urlsplit(url)
        host, _ = address.hostname, address.port
    except ValueError as error:
        raise UsageError(f"`url`: that is no URL: {error}") from error
    if not host or address.scheme not in known:
        schemes = ", ".join(f"{scheme}://" for scheme in known)
        without_key = f"{address.scheme}://{host or ''}" if address.scheme else url.rpartition("@")[2]
        raise UsageError(
            f"`url`: '{without_key}' should look like http://192.168.0.5:8000: one of {schemes}, a host, and its port"
        )
    examine_it: Examine = resolve_name(known[address.scheme])
    findings = [plain_text(address)]
    try:
        findings += examine_it(address)
    except (OSError, TransportError) as error:
        findings.append(
            Finding("server", "error", f"{host} does not answer: {printable(str(error))}", "start it, or name another")
        )
    return findings


def printable(text: str, most: int = 120) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text[:most])


def is_local(host: str) -> bool:
    with suppress(OSError, ValueError):
        return all(ip_address(each[4][0]).is_loopback for each in socket.getaddrinfo(host, None))
    return False


def plain_text(address: SplitResult) -> Finding:
    host, port = address.hostname or "", address.port or "PORT"
    if address.scheme in ENCRYPTED:
        return Finding("plain-text", "state", f"the connection to {host} is encrypted")
    if is_local(host):
        return Finding("plain-text", "state", f"{host} is this machine: nothing leaves it")
    return Finding(
        "plain-text",
        "warning",
        f"the connection to {host} is plain text: others on the network can read pictures and keys, and change actions",
        f"ssh -L {port}:127.0.0.1:{port} {host}, and then 127.0.0.1 in the URL",
    )


def no_key(address: SplitResult, what: str, cure: str) -> Finding:
    """Return the finding that a server asks for no key: a choice on this machine, a risk on any other."""
    local = is_local(address.hostname or "")
    return Finding("no-key", "advice" if local else "warning", f"it wants no key: {what}", cure)


def idle_cut(seconds: float, cure: str) -> Finding:
    message = (
        f"it closes a connection after {seconds:g} s of silence: a request after a longer pause connects again first"
    )
    return Finding("idle", "advice", message, cure)
