"""Transports with an address: where our server listens, its key, and the URL of an external server.

Options of one name are one flag for all transports. An API key is read from an environment variable, never from a
flag, and never shown; a URL must hold no secret, because results keep it.
"""

from __future__ import annotations

import errno
import os
import re
import socket
from collections.abc import Collection, Iterable
from ipaddress import ip_address
from typing import ClassVar, Final, TypeVar
from urllib.parse import parse_qsl, urlsplit

from pydantic import field_validator

from s2a_bench.errors import PortInUse, UsageError
from s2a_bench.options import option
from s2a_bench.secrets import is_secret, keep
from s2a_bench.transport import EXTERNAL, SERVER, SERVING, Transport, TransportOptions

ANY: Final = "127.0.0.1:0"
VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class UrlOptions(TransportOptions):
    SCHEMES: ClassVar[tuple[str, ...]] = ()
    ENDS_WITH_PORT: ClassVar[bool] = False
    """Whether a URL has to name a port, and has nothing after it."""

    url: str = option("", "a server that runs already (a black box)", side=EXTERNAL, risk="url")

    @field_validator("url")
    @classmethod
    def _names_a_server(cls, url: str) -> str:
        if url:
            check_url(url, cls.SCHEMES)
        if cls.ENDS_WITH_PORT and url and (not urlsplit(url).port or url.partition("//")[2] != urlsplit(url).netloc):
            raise ValueError(f"'{url.partition('?')[0]}' should look like {cls.SCHEMES[0]}://HOST:PORT")
        return url


class ListeningOptions(UrlOptions):
    host: str = option(
        "127.0.0.1", "address that our server binds; others than this machine need a key", side=SERVING, first=True
    )
    port: int = option(0, "port of the server; 0: any free one", ge=0, le=65535, side=SERVER, first=True)
    api_key_env: str = option(
        "",
        "NAME of the environment variable with the API key: of the url, or that our server wants",
        side=SERVER,
        risk="key",
        first=True,
    )
    no_auth: bool = option(False, "serve every client that reaches the host, without a key", side=SERVING)

    def check(self) -> None:
        if self.no_auth and self.api_key_env:
            raise UsageError("`no_auth` serves every client without the key of `api_key_env`; give one of them")

    def callers(self, with_key: str) -> str:
        """Return which clients our server serves, for `serve`; ``with_key`` describes those with the key {}."""
        if self.api_key_env:
            return f" for clients that {with_key.format(f'${self.api_key_env}')}"
        return " for every client" if self.no_auth else ""


L = TypeVar("L", bound=ListeningOptions)


class ListeningTransport(Transport[L]):
    def addresses(self, options: L) -> Iterable[str]:
        return f"{options.host}:{options.port}", f"{options.host}:0"


def split_address(address: str, scheme: str) -> tuple[str, str]:
    """Return host and port of ``host:port`` or of a server's `address`; 127.0.0.1 and 0 for an empty one."""
    host, _, port = (address.removeprefix(f"{scheme}://") or ANY).rpartition(":")
    return host.strip("[]") or "127.0.0.1", port


def in_url(host: str) -> str:
    """Return a host as URLs have it: an address of IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def is_loopback(host: str) -> bool:
    """Return True for localhost and an address of loopback; no name is resolved."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def bound_socket(address: str, scheme: str, options: ListeningOptions) -> tuple[socket.socket, str]:
    """Return a TCP socket that listens at an address (see `split_address`), and the key that clients must send.

    Raises PortInUse, and UsageError if other hosts could connect without a key and `no_auth` is not set.
    """
    host, port = split_address(address, scheme)
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of a server before are in TIME_WAIT
    try:
        bound.bind((host, int(port)))
        key = key_for(bound.getsockname()[0], options.api_key_env, no_auth=options.no_auth)
        bound.listen()  # only now is the port ours
    except UsageError:
        bound.close()
        raise
    except OSError as error:
        bound.close()
        raise cannot_bind(host, port, error.errno, error.strerror) from error
    return bound, key


def cannot_bind(host: str, port: str, number: int | None, why: str | None) -> PortInUse:
    if number == errno.EADDRINUSE:
        return PortInUse(f"`port`: {port} is in use on {host}; choose another, or 0 for any free one")
    blamed = "port" if number == errno.EACCES else "host"
    return PortInUse(f"`{blamed}`: cannot bind {in_url(host)}:{port}: {why}")


def check_url(url: str, schemes: Collection[str]) -> None:
    """Raise ValueError, without a password, for a text that is not a URL with one of the schemes."""
    try:
        address = urlsplit(url)
        valid = address.scheme in schemes and bool(address.hostname) and address.port != 0
    except ValueError:  # of a malformed port or IPv6 address
        valid = False
    if not valid:
        shown = re.sub(r"[^/]*@", "***@", url.partition("?")[0])
        raise ValueError(f"'{shown}' should start with {' or '.join(f'{each}://' for each in schemes)} and name a host")
    if "@" in address.netloc:
        raise ValueError("leave the password out, which would be kept with the results; see `api_key_env`")
    for name, _ in parse_qsl(address.query, keep_blank_values=True):
        if is_secret(name):
            raise ValueError(f"leave '{name}' out, which would be kept with the results; see `api_key_env`")


def read_key(variable: str) -> str:
    """Return the key that an environment variable holds, stripped; "" for no variable.

    From now on the key is struck out of everything shown or kept. Raises UsageError without repeating the name: it may
    be the key itself.
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


def key_for(host: str, variable: str, *, no_auth: bool) -> str:
    """Return the key that a server's clients must send, from the environment ``variable``; "" for none.

    Raises UsageError if other hosts can connect to ``host`` without a key and `no_auth` is not set.
    """
    key = read_key(variable)
    if not (key or no_auth or is_loopback(host)):
        raise UsageError(
            f"`host`: others reach {host}; name the environment variable that holds the key that they must send with "
            "`api_key_env`, or serve every client with `no_auth`"
        )
    return key
