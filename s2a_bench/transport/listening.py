"""What transports with an address have in common: where our server listens, whom it lets in, whose else is asked.

Options of one name are one flag for all of them.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import ClassVar, Final, TypeVar

from pydantic import field_validator

from s2a_bench.errors import PortInUse, UsageError
from s2a_bench.options import option
from s2a_bench.transport import Transport
from s2a_bench.transport.credentials import key_for
from s2a_bench.transport.options import SERVER, SERVING, Options
from s2a_bench.transport.urls import checked_url

ANY: Final = "127.0.0.1:0"
"""What is bound unless told."""


class ListeningOptions(Options):
    """How our server is reached, or somebody else's is asked."""

    SCHEMES: ClassVar[tuple[str, ...]] = ()
    """Of the URLs."""

    host: str = option("127.0.0.1", "address that our server binds; others than this machine need a key", side=SERVING)
    port: int = option(0, "port of the server; 0: any free one", ge=0, le=65535, side=SERVER)
    url: str = option("", "a server that runs already (a black box)", side=SERVER)
    api_key_env: str = option(
        "", "NAME of the environment variable with the API key: of the url, or that our server wants", side=SERVER
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


L = TypeVar("L", bound=ListeningOptions)


class Listening(Transport[L]):
    """A transport whose servers have a host and a port."""

    def foreign(self, options: L) -> str:
        """Return the URL that a user gave."""
        return options.url

    def bind(self, options: L, taken: Sequence[str]) -> str:
        """Return ``host:port``, with any free port where another server of ours has this one."""
        wanted = f"{options.host}:{options.port}"
        return f"{options.host}:0" if wanted in taken else wanted


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
