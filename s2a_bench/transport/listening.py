"""What transports with an address have in common: where our server listens, whom it lets in, whose else is asked.

Options of one name are one flag for all of them. API keys are read from the environment by the variable's name, never
from a flag, and never shown; URLs hold no secret that would be kept with results.
"""

from __future__ import annotations

import errno
import hmac
import os
import re
import socket
from collections.abc import Collection, Iterable
from ipaddress import ip_address
from typing import ClassVar, Final
from urllib.parse import parse_qsl, urlsplit

from pydantic import field_validator

from s2a_bench.errors import PortInUse, UsageError
from s2a_bench.options import option
from s2a_bench.secrets import is_secret, keep
from s2a_bench.transport import EXTERNAL, SERVER, SERVING, TransportOptions

ANY: Final = "127.0.0.1:0"
"""What is bound unless told."""
VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class ListeningOptions(TransportOptions):
    """How our server is reached, or somebody else's is asked."""

    SCHEMES: ClassVar[tuple[str, ...]] = ()
    """Of the URLs."""

    host: str = option(
        "127.0.0.1", "address that our server binds; others than this machine need a key", side=SERVING, first=True
    )
    port: int = option(0, "port of the server; 0: any free one", ge=0, le=65535, side=SERVER, first=True)
    url: str = option("", "a server that runs already (a black box)", side=EXTERNAL, risk="url")
    api_key_env: str = option(
        "",
        "NAME of the environment variable with the API key: of the url, or that our server wants",
        side=SERVER,
        risk="key",
        first=True,
    )
    no_auth: bool = option(False, "let everybody in who reaches the host, without a key", side=SERVING)

    @field_validator("url")
    @classmethod
    def _names_a_server(cls, url: str) -> str:
        return checked_url(url, cls.SCHEMES)

    def check(self) -> None:
        """Refuse a key that nobody needs."""
        if self.no_auth and self.api_key_env:
            raise UsageError("`no_auth` lets everybody in without the key of `api_key_env`; give one of them")

    def addresses(self) -> Iterable[str]:
        """Return ``host:port``, and any free port."""
        return f"{self.host}:{self.port}", f"{self.host}:0"

    def callers(self, with_key: str) -> str:
        """Return whom our server answers, as `serve` says it; ``with_key`` is who has the key of the variable {}."""
        if self.api_key_env:
            return f" for who {with_key.format(f'${self.api_key_env}')}"
        return " for all who reach it" if self.no_auth else ""


def split(address: str, scheme: str) -> tuple[str, str]:
    """Return host and port of ``host:port``, or of what a server's `address` was; without one 127.0.0.1 and 0."""
    host, _, port = (address.removeprefix(f"{scheme}://") or ANY).rpartition(":")
    return host or "127.0.0.1", port


def bound_socket(address: str, scheme: str, options: ListeningOptions) -> tuple[socket.socket, str]:
    """Return a TCP socket that listens at an address (see `split`), and the key that clients must send.

    Raises PortInUse, and UsageError where others than this machine would need no key and nobody said so.
    """
    host, port = split(address, scheme)
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, int(port)))
        key = key_for(bound.getsockname()[0], options.api_key_env, everybody=options.no_auth)
        bound.listen()  # only now is the port ours
    except UsageError:
        bound.close()
        raise
    except OSError as error:
        bound.close()
        raise cannot_bind(host, port, error.errno, error.strerror) from error
    return bound, key


def cannot_bind(host: str, port: str, number: int | None, why: str | None) -> PortInUse:
    """Return what to raise where an address cannot be had, for a system's error of this number."""
    if number == errno.EADDRINUSE:
        return PortInUse(f"`port`: {port} is in use on {host}; choose another, or 0 for any free one")
    return PortInUse(f"`port`: cannot bind {host}:{port}: {why}")


def checked_url(url: str, schemes: Collection[str]) -> str:
    """Return a URL with one of the schemes, or ""; raises ValueError for any other text, without its password."""
    if not url:
        return url
    try:
        parts = urlsplit(url)
        sound = parts.scheme in schemes and bool(parts.hostname) and parts.port != 0
    except ValueError:
        sound = False
    if not sound:
        shown = re.sub(r"[^/]*@", "***@", url.partition("?")[0])
        raise ValueError(f"'{shown}' should start with {' or '.join(f'{each}://' for each in schemes)} and name a host")
    if "@" in parts.netloc:
        raise ValueError("leave the password out, which would be kept with the results; see `api_key_env`")
    for name, _ in parse_qsl(parts.query, keep_blank_values=True):
        if is_secret(name):
            raise ValueError(f"leave '{name}' out, which would be kept with the results; see `api_key_env`")
    return url


def read_key(variable: str) -> str:
    """Return the key that an environment variable holds, without space around it; "" for no variable.

    From now on it is struck out of what is shown and kept.

    Raises UsageError, which does not repeat the name: somebody may have given the key itself.
    """
    if not variable:
        return ""
    if not VARIABLE.fullmatch(variable):
        raise UsageError("`api_key_env` takes the name of an environment variable, not the key itself")
    key = os.environ.get(variable, "").strip()
    if not key:
        raise UsageError("`api_key_env`: the environment has no such variable, or it is empty; export it first")
    if not (key.isascii() and key.isprintable()):
        raise UsageError(f"`api_key_env`: ${variable} holds what no HTTP header can carry")
    keep(key)
    return key


def key_for(host: str, variable: str, *, everybody: bool) -> str:
    """Return the key that the clients of a server must send, "" for none; ``variable`` names where it is.

    Raises UsageError where strangers reach ``host`` without a key and nobody said that ``everybody`` may.
    """
    key = read_key(variable)
    if not (key or everybody or ip_address(host).is_loopback):
        raise UsageError(
            f"`host`: others reach {host}; name the environment variable that holds the key that they must send with "
            "`api_key_env`, or let everybody in with `no_auth`"
        )
    return key


def has_key(said: bytes, scheme: str, key: bytes) -> bool:
    """Whether an Authorization header has the key, compared in constant time (RFC 6750, 2.1)."""
    name, _, token = said.partition(b" ")
    return name.lower() == scheme.lower().encode() and hmac.compare_digest(token.strip(), key)
