"""Access control of servers that a browser can reach: by the headers, before a body is read.

A page in a browser on this machine can reach servers on loopback. Its requests carry `Origin` or, after DNS rebinding,
the page's own name as `Host`.
"""

from __future__ import annotations

import hmac
import re
from collections.abc import Iterable
from http import HTTPStatus
from typing import Any, Final

from s2a_bench.options import option
from s2a_bench.transport import SERVING, Handler, Wiring
from s2a_bench.transport.listening import ListeningOptions, bound_socket, in_url, is_loopback
from s2a_bench.transport.serving import Core

HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]*\]|[^:\[\]]*)(?::[0-9]*)?")


class WebOptions(ListeningOptions):
    allow_host: str = option(
        "", "on loopback, more names that clients may send as Host, comma separated: a proxy's", side=SERVING
    )


class Access:
    """The rules of one server at the IP address ``bound_host``; clients send the ``key``, if any, with ``scheme``."""

    def __init__(self, options: WebOptions, bound_host: str, key: str, scheme: str) -> None:
        self._key, self._scheme = key.encode(), scheme
        self._names = {name.strip().lower() for name in options.allow_host.split(",")}  # "" among them
        self._on_loopback = is_loopback(bound_host)

    def refusal(self, path_is_open: bool, headers: Iterable[tuple[str, str]]) -> tuple[int, str] | None:
        """Return the status and one line for a refused request; the names of ``headers`` are in lower case."""
        keys = []
        for name, value in headers:
            if name == "origin":
                return HTTPStatus.FORBIDDEN, "this server does not answer pages in browsers, which send an Origin"
            if name == "host" and self._on_loopback and not self._is_known(value):
                return HTTPStatus.FORBIDDEN, f"this server is not {value[:80]!r}; see `serve --allow-host`"
            if name == "authorization":
                keys.append(value)
        if self._key and not path_is_open and not (len(keys) == 1 and self._has_key(keys[0])):
            return HTTPStatus.UNAUTHORIZED, f"this server wants its key: Authorization: {self._scheme} KEY"
        return None

    def _is_known(self, host: str) -> bool:
        match = HOST.fullmatch(host)
        if match is None:
            return False
        name = match[1].strip("[]").lower()
        return name in self._names or is_loopback(name)

    def _has_key(self, value: str) -> bool:
        """Return True if an Authorization header has the key, compared in constant time (RFC 6750, 2.1)."""
        name, _, token = value.encode(errors="replace").partition(b" ")
        return name.lower() == self._scheme.lower().encode() and hmac.compare_digest(token.strip(), self._key)


class WebServer:
    """A server that browsers can reach, on a socket that is bound before anything is promised."""

    def __init__(self, wiring: Wiring[Any], handler: Handler, scheme: str, key_scheme: str) -> None:
        """Bind ``host:port`` of ``wiring.address`` or what `address` was; `bound_socket` says what it raises."""
        self._listener, key = bound_socket(wiring.address, scheme, wiring.options)
        host, port = self._listener.getsockname()[:2]
        self.address = f"{scheme}://{in_url(host)}:{port}"
        self._core = Core(handler, wiring.limits)
        self._access = Access(wiring.options, host, key, key_scheme)
