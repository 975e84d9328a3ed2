"""A cell of timelines as the schema of ``--json`` holds it: what it is about, then the metrics of the table."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any

from s2a_bench.experiments.timeline.metrics import METRICS, TimelineMetric
from s2a_bench.store.bounds import Many, NonNegative, Positive, about


@dataclass(frozen=True, kw_only=True)
class _About:
    cell: str
    policy: str
    profile: Annotated[str | None, about("Null where only a rate was given, or a model answered.")]
    mode: Annotated[str, about("virtual: computed; else what passed the time.")]
    emulated: Annotated[bool, about("True where no model answered.")]
    rate_tokens_per_s: Positive
    prompt_s: Annotated[
        NonNegative | None,
        about("c: from the request to the start of decoding; absent where a model took what it took."),
    ] = None
    tokens_per_skill: Annotated[Many, about("L, the delimiter included.")]
    n_skills: Many
    t_nom_s: Positive
    plans: Annotated[Many, about("Plans that the means are over.")]
    caution: Annotated[
        NonNegative | None, about("lambda; absent where the policy has none, or waits for the whole plan.")
    ] = None


def _field(metric: TimelineMetric) -> tuple[Any, ...]:
    hint = Annotated[float | None, metric.schema] if metric.optional else Annotated[float, metric.schema]
    return (metric.name, hint, field(default=None)) if metric.optional else (metric.name, hint)


TimelineCell = make_dataclass(
    "TimelineCell",
    map(_field, METRICS.values()),
    bases=(_About,),
    namespace={"__doc__": "A policy in one setting: means over its plans."},
    frozen=True,
    kw_only=True,
)
