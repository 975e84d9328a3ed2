"""A client and servers on two hosts: an emulated link between them, the server's clock, advice on a transport."""

from pathlib import Path

SWEEPS = Path(__file__).with_name("profiles")
ADVISE = (
    "s2a_bench.plugins.two_hosts.advise:advise",
    "Advise on a transport for a link, from a sweep of transports: what is fastest.",
)
