"""`doctor --url`: what distorts a measurement of an external server, found without a request to its model.

Each transport with URLs declares its own examination (`Urls.examine`). What all share is here.
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

Examine: TypeAlias = Callable[[SplitResult], Iterator[Finding | str]]
"""Yields findings about the server at a URL with a host, and what leaves it open (NO_KEY, UNPICKLES); raises OSError or
TransportError if none answers."""

PATIENCE_S: Final = 5.0
ENCRYPTED: Final = frozenset({"https", "wss"})
NO_KEY: Final = "no key"
UNPICKLES: Final = "unpickles what it receives"


def examine(url: str) -> list[Finding]:
    """Return the findings about a URL; raises UsageError for an unknown scheme, MissingExtra."""
    known = {scheme: each for _, each in TRANSPORTS.loaded() if each.urls.examine for scheme in each.urls.schemes}
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or "PORT"
    except ValueError as error:
        raise UsageError(f"`url`: that is no URL: {error}") from error
    if not host or parts.scheme not in known:
        schemes = ", ".join(f"{scheme}://" for scheme in known)
        without_key = f"{parts.scheme}://{host}" if parts.scheme else url.rpartition("@")[2]
        raise UsageError(
            f"`url`: '{without_key}' should look like http://192.168.0.5:8000: one of {schemes}, a host, and its port"
        )
    known[parts.scheme].check_machine()
    examine_it: Examine = resolve_name(known[parts.scheme].urls.examine)
    local, results = is_local(host), list[Finding | str]()
    try:
        results += examine_it(parts)
    except (OSError, TransportError) as error:
        why = f"{host} does not answer: {printable(str(error))}"
        results.append(Finding("server", "error", why, "start it, or name another"))
    words = [each for each in results if isinstance(each, str)]
    if not local and parts.scheme not in ENCRYPTED:
        words.insert(0, "not encrypted")
    findings = [each for each in results if not isinstance(each, str)]
    if words:
        dangerous = not local or any(UNPICKLES in each for each in words)
        reach = "" if local else f", and reach it by ssh -L {port}:127.0.0.1:{port} {host}"
        cure = f"let it listen on 127.0.0.1 alone{reach}"
        findings.insert(0, Finding("access", "warning" if dangerous else "advice", f"{host}: {', '.join(words)}", cure))
    return findings


def printable(text: str, most: int = 120) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text[:most])


def is_local(host: str) -> bool:
    with suppress(OSError, ValueError):
        return all(ip_address(each[4][0]).is_loopback for each in socket.getaddrinfo(host, None))
    return False


def idle_cut(seconds: float, cure: str) -> Finding:
    what = f"it closes a connection after {seconds:g} s of silence: a request after a longer pause connects again first"
    return Finding("idle", "advice", what, cure)
