"""Cyclone DDS configuration: loopback and tuned unless the user's ROS environment or options choose otherwise.

Honoured when set: CYCLONEDDS_URI (replaces everything here), ROS_AUTOMATIC_DISCOVERY_RANGE
(OFF, LOCALHOST, SUBNET, SYSTEM_DEFAULT) and ROS_STATIC_PEERS (REP-2021-style, separated by ';').
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from s2a_bench.errors import UsageError
from s2a_bench.text import none_of

if TYPE_CHECKING:
    from s2a_bench.ros import Tuning

PEER = re.compile(r"[A-Za-z0-9._:%-]+")
RANGES = ("OFF", "LOCALHOST", "SUBNET", "SYSTEM_DEFAULT")

TUNED_GENERAL = "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize>"
TUNED_INTERNAL = '<Internal><SocketReceiveBufferSize max="16MB"/></Internal>'
"""Fragments of nearly the largest UDP datagram, and the receive buffer the kernel allows: half the time for a VGA
image, and no lost fragments at 1920x1080."""
CYCLONE_URI = "CYCLONEDDS_URI"
CYCLONE, RMW_CYCLONE, RMW_FAST = "cyclonedds", "rmw_cyclonedds_cpp", "rmw_fastrtps_cpp"
"""The carriers of messages: Cyclone DDS from PyPI, and RMWs of an installed ROS 2."""
DEFAULT_RMW = RMW_FAST
"""The RMW of Humble and Jazzy if RMW_IMPLEMENTATION is not set."""
LARGE_PICTURES = (
    f'<CycloneDDS><Domain id="any"><General>{TUNED_GENERAL}</General>{TUNED_INTERNAL}</Domain></CycloneDDS>'
)
"""Value of CYCLONEDDS_URI with which rmw_cyclonedds_cpp, too, uses these; all else remains its own choice."""

PATIENT = "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
"""Cyclone 11 stops announcing itself to addresses that have not answered for 30 s; a peer that finds others by
multicast alone, as Fast DDS does on a subnet, and starts later than that would never be met on loopback."""


def domain_id(environ: Mapping[str, str], option: int | None = None) -> int:
    """Return the DDS domain of the option, else of ROS_DOMAIN_ID, else 0; raises UsageError for an invalid one."""
    if option is not None:
        return option
    text = environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or not 0 <= int(text) <= 232:  # noqa: PLR2004 - the last domain with valid ports
        raise UsageError(f"ROS_DOMAIN_ID: '{text}' is not a number from 0 to 232; unset it or choose one")
    return int(text)


def discovery_range(environ: Mapping[str, str], default: str) -> str:
    """Return ROS_AUTOMATIC_DISCOVERY_RANGE; raises UsageError for an unknown one."""
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", default).upper()
    if reach not in RANGES:
        raise UsageError(f"ROS_AUTOMATIC_DISCOVERY_RANGE: {none_of(reach, RANGES)}")
    return reach


def static_peers(environ: Mapping[str, str]) -> list[str]:
    """Return the addresses of ROS_STATIC_PEERS; raises UsageError for an invalid one."""
    peers = [peer for peer in environ.get("ROS_STATIC_PEERS", "").split(";") if peer]
    for peer in peers:
        if not PEER.fullmatch(peer):
            raise UsageError(f"ROS_STATIC_PEERS: '{peer}' is not a host name or address; separate several with ';'")
    return peers


def configuration(environ: Mapping[str, str], tuning: Tuning) -> str | None:
    """Return the XML for ``cyclonedds.domain.Domain``, or None to leave it to the user's CYCLONEDDS_URI."""
    if environ.get("CYCLONEDDS_URI"):
        return None
    reach = discovery_range(environ, "LOCALHOST")
    peers = static_peers(environ)
    local = reach in {"OFF", "LOCALHOST"} and not peers
    if local or reach == "LOCALHOST":
        peers.insert(0, "127.0.0.1")
    interface = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>' if local else ""
    general = interface + f"<AllowMulticast>{'false' if reach in {'OFF', 'LOCALHOST'} else 'true'}</AllowMulticast>"
    if tuning == "tuned":
        general += TUNED_GENERAL
    listed = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
    return (
        f'<CycloneDDS><Domain id="any"><General>{general}</General>'
        f"{TUNED_INTERNAL if tuning == 'tuned' else ''}"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
        # with a longer interval a ROS process in SUBNET mode that starts after us is not met for 40 s
        f"<SPDPInterval>1s</SPDPInterval>{PATIENT}<Peers>{listed}</Peers></Discovery></Domain></CycloneDDS>"
    )
