"""Emulated links: client and servers in two unnamed network namespaces, joined by a relay.

The thread that enters a link is the client's side; programs and sockets made in `EmulatedLink.server_side` are the
server's. The server's address is 127.0.0.1, as without a link: there it belongs to a TUN device instead of ``lo``, and
the client reaches it through its own TUN device, 127.0.0.2. Namespaces and devices end with the processes that
use them.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import NotPermitted, UsageError
from s2a_bench.harness.processes import OwnProcess
from s2a_bench.plugins.two_hosts.links.probe import CLIENT, SERVER, probed
from s2a_bench.plugins.two_hosts.profiles import Direction, LinkProfile
from s2a_bench.provenance import Provenance
from s2a_bench.transport.surroundings import Around

DEVICE: Final = b"link"
PEERS: Final = {"ROS_STATIC_PEERS": f"{SERVER};{CLIENT}", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""The environment in which DDS finds the other side; it is on no loopback interface."""
CLONE_NEWNET: Final = 0x40000000
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
SIOCSIFFLAGS, SIOCSIFADDR, SIOCSIFDSTADDR = 0x8914, 0x8916, 0x8918
RTM_NEWLINK, NLM_F_REQUEST, IFLA_TXQLEN = 16, 1, 13
IFF_UP: Final = 0x1
QUEUE_PACKETS: Final = 10_000
"""The queue of a device, so that a packet waits for the relay instead of being lost."""
_libc = ctypes.CDLL(None, use_errno=True)


class EmulatedLink(Around):
    """A running link; the thread that made it is on the client's side."""

    def __init__(self, profile: LinkProfile, server: int, client: int, relay: OwnProcess) -> None:
        self.profile = profile
        self.directions: tuple[Direction, Direction] = profile.directions()
        self._server, self._client, self._relay = server, client, relay

    @contextmanager
    def server_side(self) -> Iterator[None]:
        """Make programs and sockets on the server's side."""
        _join(self._server)
        try:
            yield
        finally:
            _join(self._client)

    def facts(self, say: Callable[[str], None]) -> dict[str, Any]:
        """Probe the link; return what the manifest records of the profile and the probe."""
        say(f"probing the link {self.profile.name}")
        directions = [asdict(replace(way, steps=())) for way in self.directions]
        described = {"profile": self.profile.model_dump(exclude_none=True), "directions": directions}
        return {"link": described | probed(self)}

    def origin(self, origin: Provenance) -> Provenance:
        return replace(origin, link="emulated", link_profile=self.profile.about)

    def totals(self) -> dict[str, Any]:
        """Return the relay's counts of packets carried and lost, and how late it was."""
        return {"link": {"relay": self._relay.ask()}}


@contextmanager
def emulated(profile: LinkProfile) -> Iterator[EmulatedLink]:
    """Put this thread on the client's side of a link; its old namespace and environment return at the end.

    Raises NotPermitted without the right to create namespaces, UsageError if a device cannot be made.
    """
    directions = [asdict(each) for each in profile.directions()]
    with ExitStack() as stack:
        home = _opened(stack)
        _new_namespace()
        stack.callback(_join, home)
        sides, devices = [], []
        for own, peer in ((SERVER, CLIENT), (CLIENT, SERVER)):
            _new_namespace()
            sides.append(_opened(stack))
            try:
                devices.append(os.open("/dev/net/tun", os.O_RDWR | os.O_CLOEXEC))
                stack.callback(os.close, devices[-1])
                _configure(devices[-1], own, peer)
            except OSError as error:
                raise UsageError(
                    f"`link` needs a TUN device: {error}; `modprobe tun`, or in a container --device /dev/net/tun"
                ) from None
        job = json.dumps({"devices": devices[::-1], "directions": directions})
        relay = OwnProcess("relay", "s2a_bench.plugins.two_hosts.links.relay", job, None, devices)
        stack.enter_context(relay)
        relay.wait_ready()
        stack.callback(os.environ.update, {name: os.environ[name] for name in PEERS if name in os.environ})
        for name in PEERS:
            stack.callback(os.environ.pop, name, None)
        os.environ.update(PEERS)
        yield EmulatedLink(profile, sides[0], sides[1], relay)


def _opened(stack: ExitStack) -> int:
    """Return a descriptor of this thread's namespace."""
    number = os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    stack.callback(os.close, number)
    return number


def _join(namespace: int) -> None:
    if _libc.setns(namespace, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "setns")


def _new_namespace() -> None:
    if _libc.unshare(CLONE_NEWNET):
        raise NotPermitted(
            f"`link` needs network namespaces ({os.strerror(ctypes.get_errno())}): run it as root, or allow user "
            "namespaces until `unshare -Urn true` works"
        )


def _configure(tun: int, own: str, peer: str) -> None:
    """Give a new device a loopback address in place of ``lo``, so that servers bind where they always do."""
    fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", DEVICE, IFF_TUN | IFF_NO_PI))
    conf = Path("/proc/sys/net")
    (conf / "ipv4/conf/link/route_localnet").write_text("1")  # else the kernel drops 127/8 on a device that is not lo
    with suppress(OSError):  # a kernel without IPv6
        (conf / "ipv6/conf/all/disable_ipv6").write_text("1")

    def address(request: int, device: bytes, text: str) -> None:
        fcntl.ioctl(control, request, struct.pack("16sH2x4s16x", device, socket.AF_INET, socket.inet_aton(text)))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sh22x", b"lo", IFF_UP))
        address(SIOCSIFADDR, b"lo", "0.0.0.0")  # noqa: S104 - it removes 127.0.0.1/8
        address(SIOCSIFADDR, DEVICE, own)
        address(SIOCSIFDSTADDR, DEVICE, peer)
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sh22x", DEVICE, IFF_UP))
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as route:  # the ioctl needs real root
        index = socket.if_nametoindex(DEVICE.decode())
        header = struct.pack("=IHHIIBxHiII", 40, RTM_NEWLINK, NLM_F_REQUEST, 0, 0, socket.AF_UNSPEC, 0, index, 0, 0)
        route.send(header + struct.pack("=HHI", 8, IFLA_TXQLEN, QUEUE_PACKETS))
