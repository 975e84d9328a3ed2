"""What runs over an emulated link also show: the bound of its profile, and what the probe measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.requests import RequestMetric
from s2a_bench.plugins.two_hosts.profiles import Direction, LinkProfile, bound_s
from s2a_bench.writers.figures import Bar, build_bars
from s2a_bench.writers.tables import number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from s2a_bench.store.run import StoredRun

METRICS: Final = (
    RequestMetric(
        "bound",
        "The least time on the run's emulated link: the payload up at its rate, and both delays.",
        "ms",
        better="neither",
        name="bound",
    ),
    RequestMetric(
        "measured / bound",
        "e2e without inference over the bound: what a better transport could still win.",
        name="bound_ratio",
        of=lambda cell: cell.column("e2e_without_inference") / cell.column("bound"),
    ),
)


def bounded(run: StoredRun, samples: pd.DataFrame) -> pd.DataFrame:
    """Add the column ``bound_ns`` to requests on an emulated link that bring their pictures."""
    link = run.manifest.get("link") or {}
    if "directions" not in link:
        return samples
    up, down = (Direction.from_facts(facts) for facts in link["directions"])
    sent = samples["payload_bytes"].where(samples["mode"] == "request").astype("float64")
    return samples.assign(bound_ns=sent.map(lambda size: 1e9 * bound_s((up, down), size), na_action="ignore"))


def build_link(link: Mapping[str, Any]) -> Figure:
    """Draw what a probe measured of the emulated link, as a share of its profile, with the tolerance."""
    about = LinkProfile.model_construct(**link["profile"])  # runs of older versions lack defaults
    bars, others = [], []
    for quantity in link["probe"]["quantities"]:
        what, profile, measured = quantity["what"], quantity["profile"], quantity["measured"]
        if quantity["tolerance"] < profile:
            band = tuple(100 * (1 + sign * quantity["tolerance"] / profile) for sign in (-1, 1))
            bars.append(Bar(what, 100 * measured / profile, band, f"{number(measured)} {quantity['unit']}".rstrip()))
        else:
            others.append(f"{what}: {number(measured)} of {number(profile)} {quantity['unit']}".rstrip())
    notes = (f"The line is what the probe allows{''.join(f'; {each}' for each in others)}.", about.source)
    return build_bars((f"Emulated link {about.name}, probed before the run", *notes), bars, "share (%)")


def figures(run: StoredRun) -> dict[str, Callable[[], Figure]]:
    """Return the figure of a run's probe, if that measured a quantity within a tolerance."""
    link = run.manifest.get("link") or {}
    quantities = (link.get("probe") or {}).get("quantities", ())
    if not any(each["tolerance"] < each["profile"] for each in quantities):
        return {}
    return {"link": partial(build_link, link)}
