"""The options of `watch`: what is watched, and for how long."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any, ClassVar, Final
from urllib.parse import urlsplit

from pydantic import field_validator

from s2a_bench.errors import PortInUse, UsageError
from s2a_bench.options import Options, option
from s2a_bench.transport import TRANSPORTS, Transport, named_by
from s2a_bench.transport.listening import check_url, is_loopback
from s2a_bench.transport.risks import is_local

PORTS: Final = {"http": 80, "ws": 80, "https": 443, "wss": 443}
"""The ports of URLs without one."""


def schemes() -> list[str]:
    return [scheme for _, each in TRANSPORTS.loaded() if each.reader for scheme in each.urls.schemes]


class WatchOptions(Options):
    PANEL: ClassVar[str] = "Watch"

    seconds: float = option(0.0, "end after this time; 0: at Ctrl-C", ge=0, le=1e7, first=True)
    requests: int = option(0, "end after this many exchanges; 0: at Ctrl-C", ge=0, le=10**9, first=True)
    control_hz: float | None = option(
        None,
        "actions that the robot carries out in a second: when it must have run dry",
        gt=0,
        le=100_000,
        allow_inf_nan=False,
        first=True,
    )

    def to_manifest(self) -> dict[str, Any]:
        return self.model_dump(mode="json")


class WatchTap(WatchOptions):
    """A tap on connections."""

    to: str = option(
        ..., "the server, as ws://gpu-box:8000, http://, tcp:// (ZeroMQ) or grpc://", first=True, risk="url"
    )
    listen: str = option(
        "127.0.0.1:0",
        "PORT, or HOST:PORT, where the robot connects instead; 0: any free one",
        pattern=r"^(.+:)?\d+$",
        first=True,
    )
    no_auth: bool = option(
        False, "listen beyond this machine: every host that reaches the tap reaches the server", first=True
    )

    @field_validator("to")
    @classmethod
    def _names_a_server(cls, to: str) -> str:
        check_url(to, schemes())
        if not (urlsplit(to).port or urlsplit(to).scheme in PORTS):
            raise ValueError(f"'{to}' should end with a port")
        return to

    @property
    def transport(self) -> Transport[Any]:
        return TRANSPORTS[named_by(self.to)]

    @property
    def server(self) -> tuple[str, int]:
        parts = urlsplit(self.to)
        return parts.hostname or "", parts.port or PORTS[parts.scheme]

    def bound(self) -> socket.socket:
        """Return the socket that listens for the robot; raises UsageError, PortInUse."""
        host, _, port = self.listen.rpartition(":")
        host = host.strip("[]") or "127.0.0.1"
        if not (self.no_auth or is_loopback(host)):
            raise UsageError(f"`listen`: others reach {host}, and the server through it; allow it with `no_auth`")
        if int(port) == self.server[1] and is_local(self.server[0]):
            raise UsageError(f"`listen`: {port} is the server's own port; listen at another one")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            return socket.create_server((host, int(port)), family=family)
        except (OSError, OverflowError) as error:
            raise PortInUse(f"`listen`: cannot bind {self.listen}: {error}; choose another port") from error


class WatchTopics(WatchOptions):
    """A topic of observations and a topic of answers."""

    in_: str = option(
        ..., "topic of observations, as /camera/image_raw?domain_id=1; also middleware, wait_s", flag="in", first=True
    )
    out: str = option(..., "topic of answers, of any type, as /llama/token", first=True)


class WatchBag(WatchTopics):
    """The same topics, read from a recording."""

    bag: Path = option(..., "rosbag2 folder, .mcap or .db3 file: read it by its log times", first=True)
