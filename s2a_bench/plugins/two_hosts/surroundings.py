"""Two hosts: a link that is emulated between client and servers, or a server whose host has another clock."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from s2a_bench.errors import UsageError
from s2a_bench.machine.clocks import WALL_CLOCKS
from s2a_bench.options import Options, one_of, option
from s2a_bench.plugins.two_hosts.profiles import LinkProfile, load_link, published
from s2a_bench.transport import TRANSPORT
from s2a_bench.transport.pipeline import Pipeline
from s2a_bench.transport.surroundings import Around, Exchange, OtherClock, Surroundings


class HostOptions(Options):
    PANEL: ClassVar[str] = TRANSPORT

    link: str = option(
        "",
        f"emulated link between client and servers: {', '.join(published())}, a FILE (TOML, a trace as CSV), or "
        "rate=UP/DOWN,delay=MS,jitter=MS,loss=SHARE, also after a name [default: none]",
        names=published,
    )
    clock: Annotated[str, one_of(lambda: ("", *WALL_CLOCKS))] = option(
        "",
        f"with a server of ours on another host: {', '.join(WALL_CLOCKS)} also bound the clocks' offset, if they run "
        "on both hosts [default: exchanges alone]",
    )


@dataclass(frozen=True)
class TwoHosts(Surroundings):
    profile: LinkProfile | None = None
    system: str = ""
    """The service that bounds the wall clocks of both hosts, one of `WALL_CLOCKS`, or ""."""

    options: ClassVar[type[Options]] = HostOptions
    columns: ClassVar[str] = "s2a_bench.plugins.two_hosts.view:bounded"
    reads: ClassVar[Sequence[str]] = ("mode", "payload_bytes")
    metrics: ClassVar[str] = "s2a_bench.plugins.two_hosts.view:METRICS"
    figures: ClassVar[str] = "s2a_bench.plugins.two_hosts.view:figures"

    @classmethod
    def of(cls, config: HostOptions, pipelines: Sequence[Pipeline]) -> TwoHosts:
        running = next((each.options.external for each in pipelines if each.options.external_address), "")
        if config.clock and not running:
            raise UsageError("`clock` is about a server of ours on another host; name it with `url`")
        profile = load_link(config.link) if config.link else None
        if profile and running:
            raise UsageError(f"`link`: a server that runs already is not behind it; leave out `{running}`")
        if profile and (local := [each.name for each in pipelines if not each.transport.crosses_links]):
            raise UsageError(f"`link`: {', '.join(local)} sends nothing over a network; leave it out of `transport`")
        return cls(profile, config.clock)

    def around(self) -> AbstractContextManager[Around]:
        from s2a_bench.plugins.two_hosts.links import emulated

        return emulated(self.profile) if self.profile else nullcontext(Around())

    def clock(self, exchange: Exchange, shared: dict[str, Any] | None) -> OtherClock:
        from s2a_bench.plugins.two_hosts.clocks import RemoteClock

        return RemoteClock(exchange, shared, self.system)
