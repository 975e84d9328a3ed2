"""The rows of a run of a task: an episode each; and how often a cell succeeds, on the seeds that all cells share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final

from s2a_bench.bounds import Count, Fraction, Many, NonNegative, about
from s2a_bench.experiments.cells import ANY, Cells, Comparable, Metric, mean
from s2a_bench.policy.conformal import interval
from s2a_bench.store.schema import Table

if TYPE_CHECKING:
    from s2a_bench.act import Outcome
    from s2a_bench.plugins.chunks.control import Acted


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRow:
    """One episode: how it was done, and how late its actions were. Distances are in the units of `Outcome`."""

    cell: str
    mode: str
    latency: str
    seed: int
    latency_s: Annotated[NonNegative | None, mean("L", "Mean latency of its requests.", "s", "neither")]
    success: Annotated[bool, Metric("success", "Whether the task was done.", better="higher", statistic="mean")]
    reward: Annotated[float, mean("return", "Sum of the rewards.", better="higher", bounds=ANY)]
    duration_s: Annotated[
        NonNegative, mean("time", "Until its end, or its success, at the control period.", "s", "neither")
    ]
    ticks: Annotated[int, mean("ticks", "Control ticks.", "ticks", "neither")]
    stall_ticks: Annotated[int, mean("stalled", "Ticks without an action, after the first one.", "ticks", "neither")]
    age_ticks: Annotated[NonNegative | None, mean("age", "Age of the observation behind an action.", "ticks")]
    path: Annotated[NonNegative, mean("path", "Length of the path of the actions, or of the position.")]
    jerk: Annotated[NonNegative, mean("jerk", "Its third difference from tick to tick, root mean square.", "1/s^3")]
    slower: Annotated[
        float | None, mean("slower", "Live: time of a tick's step and requests, by the control period; above 1: late.")
    ]


EPISODES: Final[Table[EpisodeRow]] = Table("episodes", EpisodeRow)
COMPARED: Final = Comparable.of(EPISODES, ("p_success", "reward"), ("mode", "latency"))


def episode_row(
    names: Mapping[str, Any], seed: int, acted: Acted, period_ns: int, outcome: Outcome, *, live: bool
) -> EpisodeRow:
    """Return the row of an episode; ``names`` are its cell, mode and latency."""
    latency_ns = acted.arrival_ns[: acted.whole, -1]
    acted_on = acted.chunk >= 0
    age = acted_on.nonzero()[0] - acted.request_tick[acted.chunk[acted_on]]
    return EpisodeRow(
        **names,
        seed=seed,
        latency_s=float(latency_ns.mean() / 1e9) if latency_ns.size else None,
        duration_s=acted.chunk.size * period_ns / 1e9,
        ticks=int(acted.chunk.size),
        stall_ticks=int((~acted_on[acted_on.argmax() :]).sum()) if acted_on.any() else 0,
        age_ticks=float(age.mean()) if age.size else None,
        **asdict(outcome),
        slower=float(acted.busy_ns.mean() / period_ns) if live else None,
    )


def fixed_s(latency: str) -> float | None:
    """Return the one latency that all requests have; None if they differ."""
    try:
        return float(latency) / 1e3
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class TaskCell:
    """A mode under one latency, in ``--json``: successes with their interval, and against no latency if that was run.

    ``lost`` is the share of the seeds that fail here and succeed without latency, less that of the opposite.
    """

    cell: str
    mode: str
    latency: Annotated[str, about("As in --latency; live: the pipeline.")]
    latency_s: Annotated[NonNegative | None, about("Mean latency of its requests.")]
    episodes: Many
    successes: Count
    success: Fraction
    success_low: Annotated[Fraction, about("Its two-sided 95 % interval (Clopper and Pearson), the lower end.")]
    success_high: Fraction
    reward: float
    duration_s: Annotated[NonNegative | None, about("Mean time to a success.")]
    stall_ticks: NonNegative
    age_ticks: NonNegative | None
    path: NonNegative
    jerk: NonNegative
    slower: NonNegative | None
    lost: float | None = None
    lost_low: Annotated[float | None, about("Lower bound, 95 % one-sided, of `lost`.")] = None
    lost_high: Annotated[float | None, about("Upper bound, 95 % one-sided.")] = None

    @property
    def source(self) -> str:
        """Return the latency's name as views show it: of a run folder's cell the cell alone."""
        return self.latency.rpartition("#")[2]

    @property
    def fixed_s(self) -> float | None:
        return fixed_s(self.latency)


def task_cells(episodes: Cells[EpisodeRow]) -> list[TaskCell]:
    """Return the cells of a run; those of a mode from the least latency on."""
    cells = episodes.split()
    ends: dict[str, Any] = {name: each.frame.set_index("seed")["success"].to_dict() for name, each in cells.items()}
    without = {each.first.mode: name for name, each in cells.items() if fixed_s(each.first.latency) == 0}
    rows = [_cell(name, each, ends, without.get(each.first.mode, "")) for name, each in cells.items()]
    return sorted(rows, key=lambda cell: (cell.mode, cell.latency_s or 0.0))


def _cell(name: str, episodes: Cells[EpisodeRow], ends: Mapping[str, Mapping[int, bool]], without: str) -> TaskCell:
    count, done = len(episodes), int(sum(ends[name].values()))
    means = ("latency_s", "reward", "duration_s", "stall_ticks", "age_ticks", "path", "jerk", "slower")
    low, high = interval(done, count)
    values: dict[str, Any] = {metric: episodes.mean(metric) for metric in means}
    values["duration_s"] = episodes.where(success=True).mean("duration_s")
    without = "" if name == without else without
    pairs = [(ends[without].get(seed), here) for seed, here in ends[name].items()] if without else []
    return TaskCell(
        cell=name,
        mode=episodes.first.mode,
        latency=episodes.first.latency,
        episodes=count,
        successes=done,
        success=done / count,
        success_low=low,
        success_high=high,
        **values,
        **(_lost([pair for pair in pairs if pair[0] is not None]) if without else {}),
    )


def _lost(pairs: list[tuple[bool | None, bool]]) -> dict[str, float]:
    """Return the paired difference of two shares on the same seeds, and its bounds.

    Only seeds with different ends say something (McNemar): each of the two kinds has an exact bound at 97.5 %, so that
    both hold with 95 %.
    """
    count = len(pairs)
    lost, won = (sum(pair == kind for pair in pairs) for kind in ((True, False), (False, True)))
    (lost_low, lost_high), (won_low, won_high) = interval(lost, count), interval(won, count)
    return {"lost": (lost - won) / count, "lost_low": lost_low - won_high, "lost_high": lost_high - won_low}
