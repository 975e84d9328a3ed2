"""`doctor --url`: what distorts a measurement of an external server, found without a request to its model.

Each transport with URLs declares its own examination (`Urls.examine`), and whether such servers unpickle.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from ipaddress import ip_address
from pkgutil import resolve_name
from typing import Final, TypeAlias
from urllib.parse import SplitResult, urlsplit

from s2a_bench.errors import RequestFailed, TransportError, UsageError
from s2a_bench.machine.doctor import Finding
from s2a_bench.transport import TRANSPORTS

Examine: TypeAlias = Callable[[SplitResult], Iterator[Finding]]
"""Yields findings about the server at a URL with a host; raises OSError or TransportError if none answers."""

PATIENCE_S: Final = 5.0
ENCRYPTED: Final = frozenset({"https", "wss"})


def examine(url: str) -> list[Finding]:
    """Return the findings about a URL; raises UsageError for an unknown scheme, MissingExtra."""
    by_scheme = {scheme: each for _, each in TRANSPORTS.loaded() if each.urls.examine for scheme in each.urls.schemes}
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port or "PORT"
    except ValueError as error:
        raise UsageError(f"`url`: that is not a URL: {error}") from error
    if not host or parts.scheme not in by_scheme:
        schemes = ", ".join(f"{scheme}://" for scheme in by_scheme)
        without_key = f"{parts.scheme}://{host}" if parts.scheme else url.rpartition("@")[2]
        raise UsageError(
            f"`url`: '{without_key}' should look like http://192.168.0.5:8000: one of {schemes}, a host, and its port"
        )
    transport, local = by_scheme[parts.scheme], is_local(host)
    transport.check_machine()
    exposed = [] if local or parts.scheme in ENCRYPTED else ["not encrypted, so a key can be read on the way"]
    exposed += [transport.urls.unpickles] if transport.urls.unpickles else []
    findings: list[Finding] = []
    if exposed:
        reach = "" if local else f", and reach it by ssh -L {port}:127.0.0.1:{port} {host}"
        cure = f"let it listen on 127.0.0.1 alone{reach}"
        findings.append(Finding("access", "advice" if local else "warning", f"{host}: {'; '.join(exposed)}", cure))
    examine_it: Examine = resolve_name(transport.urls.examine)
    try:
        findings += examine_it(parts)
        findings.append(Finding("server", "state", f"{host} answers"))
    except RequestFailed as error:  # it may take a client with a key
        findings.append(Finding("server", "state", f"{host} refuses: {_line(error)}"))
    except (OSError, UnicodeError, TransportError) as error:
        why = f"{host} does not answer: {_line(error)}"
        findings.append(Finding("server", "error", why, "start it, or name another"))
    return findings


def _line(error: Exception) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in str(error)[:120])


def connect(parts: SplitResult) -> Iterator[Finding]:
    """Find out whether something listens; nothing is sent."""
    if not parts.port:
        raise TransportError(f"name its port: {parts.scheme}://{parts.hostname}:PORT")
    socket.create_connection((parts.hostname or "", parts.port), PATIENCE_S).close()
    yield from ()


def is_local(host: str) -> bool:
    with suppress(OSError, ValueError):
        return all(ip_address(each[4][0]).is_loopback for each in socket.getaddrinfo(host, None))
    return False


def idle_cut(seconds: float, cure: str) -> Finding:
    what = f"it closes a connection after {seconds:g} s of silence: a request after a longer pause connects again first"
    return Finding("idle", "advice", what, cure)
