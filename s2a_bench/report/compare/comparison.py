"""Compare two runs, or two sets of launches: cells, changes, test and warnings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

from s2a_bench.errors import UnlikeRuns, UsageError
from s2a_bench.experiments import EXPERIMENTS, experiment_of
from s2a_bench.experiments.cells import Comparable, Metric, Subject, by_name
from s2a_bench.provenance import Origins, joined
from s2a_bench.report.compare.agreement import Difference, as_line, differences
from s2a_bench.stats.batches import STATISTICS, Rows
from s2a_bench.stats.change import Change, change_between, holm
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.run import StoredRun, fits, read_run

LEVEL: Final = 0.05
"""The probability of any false difference, over all comparisons together."""

IN_TURN: Final = "measure A and B in turn, a launch each, three times or more, and name the folders with commas"
_UNDATED: Final = "may not have been measured in turn (a manifest has no `started`)"

SAME, UNCLEAR, TOO_FEW = "same", "unclear", "too few"


@dataclass(frozen=True, slots=True)
class CellPair:
    """One cell in the launches of both sides; never empty."""

    baseline: tuple[Subject, ...]
    other: tuple[Subject, ...]

    @property
    def name(self) -> str:
        return self.baseline[0].name


@dataclass(frozen=True, slots=True)
class CellComparison:
    """One statistic of one cell: its change, the p-value corrected for all comparisons, and the verdict.

    ``detectable`` is the smallest rise, as a share, that the test finds in `POWER` of repeats.
    """

    pair: CellPair
    metric: Metric
    statistic: str
    n: tuple[int, int]
    change: Change
    p_holm: float | None = None
    verdict: str = TOO_FEW
    detectable: float | None = None

    @property
    def name(self) -> str:
        return f"{self.metric.name}.{self.statistic}"


@dataclass(frozen=True, slots=True)
class ComparedRuns:
    """Two sides, their pairs of cells, and the comparisons; ``only`` has the cells of each side without a partner.

    ``started`` has the time at which the run of each launch started, empty if unknown.
    """

    baseline: tuple[StoredRun, ...]
    other: tuple[StoredRun, ...]
    by: Comparable
    metrics: Mapping[str, Metric]
    differences: tuple[Difference, ...]
    pairs: tuple[CellPair, ...]
    only: tuple[tuple[str, ...], tuple[str, ...]]
    least: float
    started: tuple[tuple[str, ...], ...]
    comparisons: tuple[CellComparison, ...] = ()

    @property
    def launches(self) -> int:
        """Return the launches of the side with fewer; if they are several, they are the units of the test."""
        return min(len(self.pairs[0].baseline), len(self.pairs[0].other))

    def launches_below(self, fewest: int) -> bool:
        """Return True if a side has fewer launches; False for computed runs, which do not vary between launches."""
        return self._measured and self.launches < fewest

    @property
    def _measured(self) -> bool:
        return any(pair.baseline[0].setting.get("mode") != "virtual" for pair in self.pairs)

    @property
    def out_of_turn(self) -> str:
        """Return how the sides do not take turns, so that a drift of the machine looks like a change; else empty.

        They do if the side changes two thirds as often as in a random order, in the mean 2ab / (a + b) times (Wald and
        Wolfowitz 1940): turns of one or two launches do, blocks of three do not.
        """
        a, b = map(len, self.started)
        order = sorted((when, side) for side, launches in enumerate(self.started) for when in launches)
        known = all(when for when, _ in order)
        changes = sum(one != two for (_, one), (_, two) in pairwise(order)) if known else 1
        if not self._measured or 3 * changes * (a + b) >= 4 * a * b:
            return ""
        turns = f"were not measured in turn ({a + b} launches, changes of side: {changes})"
        return f"A and B {turns if known else _UNDATED}, so a drift of the machine looks like a change"

    @property
    def origins(self) -> Origins:
        return joined(run.origins for run in (*self.baseline, *self.other))

    @property
    def command(self) -> str:
        return str(self.baseline[0].manifest["command"])


def open_comparison(
    baseline: Sequence[StoredRun], other: Sequence[StoredRun], *, unlike: bool, least: float
) -> ComparedRuns:
    """Pair the cells of two sides; ``least`` is the smallest relevant change, as a share.

    Raises UnlikeRuns if machine, model or settings differ and ``unlike`` does not allow it, UsageError if the runs are
    of different commands.
    """
    runs = (*baseline, *other)
    commands = list(dict.fromkeys(str(run.manifest["command"]) for run in runs))
    if len(commands) > 1:
        raise UsageError(f"these are runs of {' and '.join(commands)}: name runs of one command")
    experiment = experiment_of(commands[0])
    by = experiment.compared_by() if experiment else None
    if by is None:
        known = ", ".join(sorted(name for name, each in EXPERIMENTS.loaded() if each.compared))
        raise UsageError(f"runs of {commands[0]} cannot be compared, only those of {known}")
    with fits(*runs):
        dated = [[each for run in side for each in _launches(run, by.subjects(run))] for side in (baseline, other)]
        sides = [[launch for _, launch in side] for side in dated]
        differ = list(dict.fromkeys(difference for run in runs[1:] for difference in differences(runs[0], run)))
        metrics = {**by.metrics, **by_name(metric for run in runs for metric in by.run_metrics(run))}
    if (len(sides[0]) > 1) != (len(sides[1]) > 1):
        raise UsageError(
            "name several launches on both sides, or one on each: the test uses launches or requests; "
            "`launches` measures several in one run"
        )
    fatal = [difference for difference in differ if difference.fatal]
    if fatal and not unlike:
        raise UnlikeRuns(f"the runs are unlike: {as_line(fatal)}; `unlike` compares them anyway")
    pairs, only, settings = _match(sides[0], sides[1])
    if settings and not unlike:
        raise UnlikeRuns(f"cells of one name differ: {as_line(settings)}; `unlike` compares them anyway")
    if not pairs:
        raise UnlikeRuns(f"no cell is in every run: {', '.join(only[0])} against {', '.join(only[1])}")
    started = tuple(tuple(when for when, _ in side) for side in dated)
    return ComparedRuns(
        tuple(baseline), tuple(other), by, metrics, (*settings, *differ), tuple(pairs), only, least, started
    )


def _launches(run: StoredRun, subjects: Iterable[Subject]) -> list[tuple[str, dict[str, Subject]]]:
    """Return when a run started and name -> cell, for each launch; raises UnlikeRuns if it has none."""
    launches: dict[int, dict[str, Subject]] = {}
    for subject in subjects:
        launches.setdefault(subject.launch, {})[subject.name] = subject
    if not launches:
        raise UnlikeRuns(f"{run.path} has no complete cell, its state is {run.manifest['state']}: measure it again")
    return [(str(run.manifest.get("started") or ""), launch) for launch in launches.values()]


def _match(
    baseline: list[dict[str, Subject]], other: list[dict[str, Subject]]
) -> tuple[list[CellPair], tuple[tuple[str, ...], tuple[str, ...]], list[Difference]]:
    """Pair the cells that every launch has; also return the other cells, and the settings that differ in a pair."""
    everywhere = [name for name in baseline[0] if all(name in run for run in (*baseline, *other))]
    pairs = [CellPair(tuple(run[name] for run in baseline), tuple(run[name] for run in other)) for name in everywhere]
    left = [
        tuple(dict.fromkeys(name for run in side for name in run if name not in everywhere))
        for side in (baseline, other)
    ]
    settings: dict[Difference, None] = {}
    for pair in pairs:
        first = pair.baseline[0]
        for subject in (*pair.baseline[1:], *pair.other):
            for key, value in first.setting.items():
                if (other_value := subject.setting.get(key)) != value:
                    settings[Difference(f"{pair.name} {key}", value, str(other_value), fatal=True)] = None
    return pairs, (left[0], left[1]), list(settings)


def metrics_of(compared: ComparedRuns, names: Sequence[str]) -> list[tuple[Metric, str]]:
    """Return metric and statistic of each NAME or NAME.STATISTIC or ``all``, or the default ones; raises UsageError."""
    if not names:
        return [(compared.metrics[name], compared.metrics[name].statistic) for name in compared.by.shown]
    wanted: dict[tuple[Metric, str], None] = {}
    for name in names:
        if name == "all":
            wanted |= {(metric, metric.statistic): None for metric in compared.metrics.values()}
        else:
            wanted[metric_of(compared, name, "`metric`")] = None
    return list(wanted)


def metric_of(compared: ComparedRuns, name: str, flag: str) -> tuple[Metric, str]:
    """Parse NAME or NAME.STATISTIC; raises UsageError for an unknown metric, or if no cell has it."""
    metrics = compared.metrics
    stem, dot, statistic = name.rpartition(".")
    if name in metrics:
        metric, statistic = metrics[name], metrics[name].statistic
    elif dot and stem in metrics and statistic in STATISTICS:
        metric = metrics[stem]
    else:
        has = [one for one in metrics if any(_rows(pair, one) for pair in compared.pairs)]
        known = f"the statistics are {', '.join(STATISTICS)}" if stem in metrics else f"there are {', '.join(has)}"
        raise UsageError(f"{flag}: '{name}' is not a metric of these {compared.command} runs; {known}")
    if not any(_rows(pair, metric.name) for pair in compared.pairs):
        raise UsageError(f"{flag}: no cell has {metric.name} on both sides")
    return metric, statistic


def compare(compared: ComparedRuns, wanted: Sequence[tuple[Metric, str]]) -> ComparedRuns:
    """Compare every cell by every metric that it has on both sides.

    The detectable change is that of the first step of Holm's correction, which has the strictest level.
    """
    with fits(*compared.baseline, *compared.other):
        every = [one for metric, statistic in dict.fromkeys(wanted) for one in changes(compared, metric, statistic)]
    corrected = holm([one.change.p for one in every])
    judged = [
        replace(
            one,
            p_holm=p,
            verdict=verdict(one.change, p, one.metric, compared.least),
            detectable=detectable(one.change, len(every)),
        )
        for one, p in zip(every, corrected, strict=True)
    ]
    return replace(compared, comparisons=tuple(judged))


def detectable(change: Change, tests: int, *, falls: bool = False) -> float | None:
    """Return the smallest rise (or fall) that one of several tests finds; None for a change without noise."""
    return None if change.noise is None else change.noise.detectable(LEVEL / tests, falls=falls)


def changes(compared: ComparedRuns, metric: Metric, statistic: str) -> Iterator[CellComparison]:
    """Yield the change of each cell that has the metric on both sides, without correction and verdict."""
    for pair in compared.pairs:
        if rows := _rows(pair, metric.name):
            exact = all(subject.exact for subject in (*pair.baseline, *pair.other))
            change = change_between(rows[0], rows[1], statistic, seed=compared.baseline[0].bootstrap_seed, exact=exact)
            n = [sum(len(launch) for launch in side) for side in rows]
            yield CellComparison(pair, metric, statistic, (n[0], n[1]), change)


def _rows(pair: CellPair, metric: str) -> tuple[list[Rows], list[Rows]] | None:
    """Return the rows of every launch, None if one has none."""
    sides = [[subject.rows(metric) for subject in side] for side in (pair.baseline, pair.other)]
    return (sides[0], sides[1]) if all(all(side) for side in sides) else None


def verdict(change: Change, p_holm: float | None, metric: Metric, least: float) -> str:
    """Return the verdict on a change.

    It is better or worse, or for a metric without a direction lower or higher, if the corrected p is below `LEVEL` and
    the size reaches ``least``. It is "same" if the whole interval is within ``least``, else "unclear".
    """
    if p_holm is None:
        return TOO_FEW
    relative, bounds = change.relative, change.bounds
    if p_holm < LEVEL and (relative is None or abs(relative) >= least):
        rises = change.other > change.baseline
        if metric.better == "neither":
            return "higher" if rises else "lower"
        return "better" if rises == (metric.better == "higher") else "worse"
    return SAME if bounds and max(map(abs, bounds)) <= least else UNCLEAR


def read_side(text: str, flag: str) -> list[StoredRun]:
    """Read one run folder, or several with commas; raises UsageError, StoreError."""
    folders = [part.strip() for part in text.split(",") if part.strip()]
    if not folders:
        raise UsageError(f"{flag}: name a run folder")
    if len(set(folders)) < len(folders):
        raise UsageError(f"{flag}: a folder is named twice; every launch counts once")
    return [read_run(Path(folder)) for folder in folders]


def warnings_of(compared: ComparedRuns) -> list[RunWarning]:
    """Return the warnings about a comparison, the most important first."""
    return [*_of_runs(compared), *_of_cells(compared)]


def _of_runs(compared: ComparedRuns) -> Iterator[RunWarning]:
    if fatal := [one for one in compared.differences if one.fatal]:
        yield RunWarning("unlike", f"the runs are unlike: {as_line(fatal)}", "a change may come from any of them")
    for run in (*compared.baseline, *compared.other):
        if (state := run.manifest["state"]) != "finished":
            yield RunWarning("state", f"{run.path} is {state}, not finished", "its samples so far count; run it again")
        if codes := sorted({warning["code"] for warning in run.manifest.get("warnings", [])}):
            yield RunWarning("warnings", f"{run.path} has warnings: {', '.join(codes)}", "read them in its manifest")
    if compared.launches_below(2):
        within = "one launch a side: the intervals do not include the variation between launches"
        yield RunWarning("one-launch", within, IN_TURN)
    if out_of_turn := compared.out_of_turn:
        yield RunWarning("turns", out_of_turn, IN_TURN)


def _of_cells(compared: ComparedRuns) -> Iterator[RunWarning]:
    if names := sorted({one.pair.name for one in compared.comparisons if one.change.dependent}):
        yield RunWarning(
            "dependent",
            f"neighbouring requests are correlated, and the intervals too narrow ({', '.join(names)})",
            "measure longer, or repeat the launches",
        )
    for side, cells in zip(("A", "B"), compared.only, strict=True):
        if cells:
            yield RunWarning("only", f"only in {side}: {', '.join(cells)}", "they are not compared")
    for pair in compared.pairs:
        for side, subjects in (("A", pair.baseline), ("B", pair.other)):
            if failed := sum(subject.errors for subject in subjects):
                total = failed + sum(subject.n for subject in subjects)
                message = f"{pair.name}: {failed} of {total} requests failed in {side}"
                yield RunWarning("errors", message, "see samples.csv")
    if harmless := [one for one in compared.differences if not one.fatal]:
        yield RunWarning("differs", as_line(harmless), "this may be what you compare")
