"""What a CCRB run holds: the operating point, and where in its studies the paper's ordering of the policies holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.experiments.ccrb.rows import ROLLOUTS
from s2a_bench.experiments.timeline.rows import SKILLS
from s2a_bench.scenario.ccrb.cars import LEAST_IMPACT_MPS
from s2a_bench.scenario.ccrb.words import PAPER
from s2a_bench.store.requests import TOKENS
from s2a_bench.store.schema import PROVENANCE

if TYPE_CHECKING:
    import pandas as pd

    from s2a_bench.store.run import Run

FOLLOWER_LAW: Final = "follower_law"
"""What a manifest says since followers have their published names."""
EARLIER_FOLLOWERS: Final = {"idm": "hybrid"}
_TIMES: Final = ("start", "end", "stall", "deadline")


@dataclass(frozen=True, slots=True)
class Share:
    """How often something is so: ``k`` of ``n``, and the 95 % Clopper-Pearson interval."""

    k: int
    n: int

    @property
    def value(self) -> float:
        """Return the share."""
        return self.k / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Return the interval, for scenarios that were drawn independently."""
        from scipy.stats import binomtest

        found = binomtest(self.k, self.n).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)


def rollouts_of(run: Run, study: str) -> pd.DataFrame:
    """Return the roll-outs of the operating point (point), the phase diagram (phase) or random scenarios (random)."""
    rows = run.table(ROLLOUTS)
    rows = rows[rows["study"] == study].reset_index(drop=True)
    return rows if FOLLOWER_LAW in run.manifest else rows.replace({"follower": EARLIER_FOLLOWERS})


def cells_of(run: Run) -> list[dict[str, Any]]:
    """Return each policy's roll-out at the operating point: names and metrics, times in s; what it lacks is no key."""
    return [_cell(row) for row in rollouts_of(run, "point").to_dict("records")]


def scenes_of(run: Run, study: str, gap: str) -> pd.DataFrame:
    """Return a row a scenario of a study under one gap behaviour, with columns of truth values for each ordering.

    ``paper``: naive is hit from behind only, wait-then-act hits the lead only, stream-to-act nobody. ``wait_worse``,
    ``wait_better``, ``naive_worse``, ``naive_better``: against stream-to-act, an impact faster by more than .5 m/s
    (none counts as 0); ``naive_rear_worse`` and ``naive_rear_better``: the same for impacts from behind alone.
    ``survives``: the car behind stops behind an ego whose tokens come at once; null in folders from before.
    """
    import pandas as pd

    rows = rollouts_of(run, study)
    rows = rows[rows["gap_behaviour"] == gap]
    policies = {name: group.set_index("draw").sort_index() for name, group in rows.groupby("policy")}
    mine = policies["stream-to-act"]
    found = mine[["tokens_per_s", "rear_gap_m", "front_gap_m", "reaction_s", "lead_decel_mps2"]].copy()
    for name, group in policies.items():
        found[name] = group["outcome"]
    found["paper"] = pd.concat([policies[name]["outcome"] == outcome for name, outcome in PAPER.items()], axis=1).all(
        axis=1
    )
    found["survives"] = mine["follower_survives"]
    for short, name in (("wait", "wait-then-act"), ("naive", "naive")):
        found[f"{short}_worse"], found[f"{short}_better"] = _compared(policies[name], mine, "impact_speed_mps")
    found["naive_rear_worse"], found["naive_rear_better"] = _compared(policies["naive"], mine, "rear_impact_mps")
    return found


def share_of(scenes: pd.DataFrame, ordering: str) -> Share:
    """Count the scenarios in which an ordering holds."""
    return Share(int(scenes[ordering].sum()), len(scenes))


def survives_of(rows: pd.DataFrame) -> bool:
    """Return whether the car behind passes its check at the operating point; True in folders from before."""
    return bool(rows["follower_survives"].fillna(True).all())


def rate_span(run: Run, gap: str) -> tuple[float, float] | None:
    """Return the least and greatest R of the phase diagram at which the paper's ordering holds; None where nowhere."""
    scenes = scenes_of(run, "phase", gap)
    rates = scenes[scenes["paper"]]["tokens_per_s"]
    return (float(rates.min()), float(rates.max())) if len(rates) else None


def rate_span_here(run: Run, gap: str) -> tuple[float, float] | None:
    """Return the same at the grid's rear gap that is nearest to the operating point's."""
    scenes = scenes_of(run, "phase", gap)
    wanted = configuration(run)["rear_gap_m"]
    nearest = min(scenes["rear_gap_m"].unique(), key=lambda gap_m: abs(gap_m - wanted))
    rates = scenes[scenes["paper"] & (scenes["rear_gap_m"] == nearest)]["tokens_per_s"]
    return (float(rates.min()), float(rates.max())) if len(rates) else None


def has(run: Run, study: str) -> bool:
    """Return whether a run holds a study."""
    return bool((run.table(ROLLOUTS)["study"] == study).any())


def configuration(run: Run) -> dict[str, Any]:
    """Return what was asked for, the follower by the name that it has now."""
    found: dict[str, Any] = run.manifest["configuration"]
    if FOLLOWER_LAW in run.manifest:
        return found
    return {**found, "follower": EARLIER_FOLLOWERS.get(found["follower"], found["follower"])}


def token_times_s(run: Run) -> list[float]:
    """Return when the tokens of the shown plan arrived, in s from the request."""
    request_id = run.table(SKILLS)["request_id"].iloc[0]
    tokens = run.table(TOKENS)
    zero_ns = run.manifest.get("request", {}).get("requested_ns", 0)
    return [(int(at_ns) - zero_ns) / 1e9 for at_ns in tokens[tokens["request_id"] == request_id]["client_ns"]]


def _cell(row: dict[Any, Any]) -> dict[str, Any]:
    """Return one roll-out with the keys of the JSON object."""
    import pandas as pd

    plain = {str(name): value for name, value in row.items() if not pd.isna(value)}
    for name in ("study", "draw", "title", PROVENANCE):
        plain.pop(name, None)
    for name in _TIMES:
        plain[f"{name}_s"] = plain.pop(f"{name}_ns") / 1e9
    plain["rate_tokens_per_s"] = plain.pop("tokens_per_s")
    plain["profile"] = plain.pop("board") or None
    return plain


def _compared(theirs: pd.DataFrame, mine: pd.DataFrame, column: str) -> tuple[pd.Series[Any], pd.Series[Any]]:
    """Return where a policy's impact is faster than stream-to-act's, and where slower."""
    difference = theirs[column].astype("float64").fillna(0.0) - mine[column].astype("float64").fillna(0.0)
    return difference > LEAST_IMPACT_MPS, difference < -LEAST_IMPACT_MPS
