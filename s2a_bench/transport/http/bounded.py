"""The network under httpx, bounded: whatever a server sends, headers and interim answers too, counts and takes time.

httpx's own time-outs are for one read each, so that a byte a second, or ``103`` after ``103``, never ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import httpcore
import httpx

from s2a_bench.transport.bounds import Bounds


class BoundedClient(httpx.Client):
    """An httpx client that reads no more, and waits no longer, than the bounds of the request under way allow."""

    def __init__(self, bounds: Bounds, **options: Any) -> None:
        """Build the client; the options are httpx's."""
        # compression would delay tokens, and a few bytes could become gigabytes
        super().__init__(headers={"accept-encoding": "identity"}, **options)
        self.bounds = bounds
        # httpx has no option for httpcore's network backend, and a transport of our own would know no proxies
        for transport in (self._transport, *self._mounts.values()):
            if isinstance(transport, httpx.HTTPTransport):
                pool = transport._pool  # noqa: SLF001
                pool._network_backend = _Network(pool._network_backend, lambda: self.bounds)  # noqa: SLF001


class _Network(httpcore.NetworkBackend):
    """Opens bounded streams."""

    def __init__(self, backend: httpcore.NetworkBackend, bounds: Callable[[], Bounds]) -> None:
        self._backend, self._bounds = backend, bounds

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        timeout = _least(timeout, self._bounds().left_s())
        stream = self._backend.connect_tcp(host, port, timeout, local_address, socket_options)
        return _Stream(stream, self._bounds)


class _Stream(httpcore.NetworkStream):
    """A connection whose reads and writes end with the bounds."""

    def __init__(self, stream: httpcore.NetworkStream, bounds: Callable[[], Bounds]) -> None:
        self._stream, self._bounds = stream, bounds

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        bounds = self._bounds()
        try:
            data = self._stream.read(max_bytes, _least(timeout, bounds.left_s()))
        except httpcore.TimeoutException:
            bounds.left_s()  # tells if it was the deadline
            raise
        bounds.came(len(data))
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        bounds = self._bounds()
        try:
            self._stream.write(buffer, _least(timeout, bounds.left_s()))
        except httpcore.TimeoutException:
            bounds.left_s()
            raise

    def start_tls(
        self, ssl_context: Any, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        timeout = _least(timeout, self._bounds().left_s())
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, timeout), self._bounds)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)

    def close(self) -> None:
        self._stream.close()


def _least(timeout: float | None, left_s: float) -> float:
    return left_s if timeout is None else min(timeout, left_s)
