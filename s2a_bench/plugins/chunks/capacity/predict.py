"""The prediction: fleets in virtual time under the service times of one robot, and how many robots these carry."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import Final

import numpy as np

from s2a_bench.boards.latency import STRETCH, read_delays
from s2a_bench.errors import UsageError
from s2a_bench.machine import environment
from s2a_bench.plugins.chunks.capacity.config import CapacityPredicted, RobotLoad, SearchPlan
from s2a_bench.plugins.chunks.capacity.metrics import measures
from s2a_bench.plugins.chunks.capacity.rows import FLEETS, KNEES, FleetRow, KneeRow
from s2a_bench.plugins.chunks.capacity.search import Judge, Tried, knee, search
from s2a_bench.plugins.chunks.capacity.simulate import UNKNOWN, ServiceTime, simulate
from s2a_bench.plugins.chunks.latencies import Source, sources
from s2a_bench.plugins.chunks.modes import Ints
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import RunWriter

SEEDS: Final = 5
"""Seeds of a predicted knee."""
LEVEL: Final = 0.95
BIASED: Final = (
    "the whole latency of one robot, as the server sends no marks: what is spent beside it counts too, which predicts "
    "more stalls and fewer robots than there are"
)
MOST: Final = 20_000_000
"""Ticks, or requests without a control clock, of a fleet in virtual time."""


@dataclass(frozen=True, slots=True, eq=False)
class Service:
    """A server's times of shape (R, 3), as `ServiceTime`, recorded in order or drawn from a source."""

    source: Source
    recorded_ns: Ints | None
    mean_ns: float
    servers: int = 1
    """The number of servers, which share one queue."""
    slower: Sequence[float] = (1.0,)
    """The factors of `simulate.serve`."""

    @staticmethod
    def read(written: str, servers: int = 1, batch: Path | None = None) -> Service:
        """Read one source, and a file of batches, as users write them; raises S2AError naming the field.

        Of measured requests it takes the engine's times; service times that are given have no first piece.
        """
        with _named("predict"):
            source, *others = sources(written, 1)
        if others:
            names = ", ".join(each.name for each in (source, *others))
            raise UsageError(f"`predict`: {written} has several cells; name one of {names}")
        if source.profile:
            raise UsageError(f"`predict`: {written} is a profile of tokens; give service times, or a run folder")
        recorded_ns = source.service_ns
        if recorded_ns is None and (given_ns := source.recorded_ns) is not None:
            recorded_ns = np.stack([np.full_like(given_ns, UNKNOWN), given_ns, np.zeros_like(given_ns)], 1)
        drawn_ns = source.draw(np.random.default_rng(0), STRETCH) if recorded_ns is None else recorded_ns[:, 1]
        if not drawn_ns.any():
            raise UsageError(f"`predict`: {source.name} takes no time; it would carry any number of robots")
        slower = read_batches(batch) if batch is not None else (1.0,)
        return Service(source, recorded_ns, float(drawn_ns.mean()), servers, slower)

    @property
    def about(self) -> str:
        """The source of the service times, in words."""
        if not self.source.requests:
            return "as given"
        if self.source.requests[0]["server_out_ns"] is None:
            return BIASED
        return "from the engine's start to its last piece"

    def times(self, rng: np.random.Generator) -> Iterator[ServiceTime]:
        """Return endless service times; a recording is played from a random request on, again and again."""
        if self.recorded_ns is not None:
            turned = np.roll(self.recorded_ns, -int(rng.integers(len(self.recorded_ns))), axis=0)
            return chain.from_iterable(repeat([ServiceTime(*row) for row in turned.tolist()]))
        draws = (self.source.draw(rng, STRETCH).tolist() for _ in repeat(None))
        return (ServiceTime(UNKNOWN, each) for each in chain.from_iterable(draws))


def read_batches(path: Path) -> Sequence[float]:
    """Read by how many times longer 1, 2, ... requests take together than one; raises UsageError naming `batch`.

    The CSV file has a column ``batch`` and one of `boards.latency`; sizes between those of its rows are interpolated.
    """
    with _named("batch"):
        latency_ns = read_delays(path)
    with path.open(encoding="utf-8-sig", newline="") as file:
        written = [row.get("batch") or "" for row in csv.DictReader(file)]
    sizes = [int(each) for each in written if re.fullmatch("[1-9][0-9]{0,3}", each)]
    if len(sizes) < len(written) or sizes[0] != 1 or sorted({*sizes}) != sizes or not latency_ns.all():
        raise UsageError(f"`batch`: {path} needs a column batch, 1 and larger sizes up to 9999, and times above 0")
    slower: list[float] = (np.interp(np.arange(1, sizes[-1] + 1), sizes, latency_ns) / latency_ns[0]).tolist()
    return slower


def run_predicted(config: CapacityPredicted, output: Path, progress: Progress) -> Path:
    """Predict every mode and return the run folder; raises S2AError."""
    service, search = Service.read(config.predict, config.servers, config.batch), config.search
    if search.limit is not None and search.limit.column.startswith("ttft") and not service.source.requests:
        raise UsageError(
            "`limit`: service times that are given have no first piece; take latency_p99, or `predict` a run"
        )
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"fleets": config.seed},
        "provenance": Origins(service.source.provenance, {}).to_manifest(),
    }
    with RunWriter.create(output, "capacity", manifest, (FLEETS, KNEES)) as writer:
        progress.opened(writer.path)
        progress.say(f"service times: {service.about}")
        for load in config.loads:
            name = load.of(service.source.name)
            Prediction(load, search, name, service, progress).write(writer)
        return writer.path


@dataclass(slots=True)
class Prediction:
    """The fleets of one cell in virtual time; a seed draws their phases, and the order of the service times."""

    load: RobotLoad
    search: SearchPlan
    cell: str
    service: Service
    progress: Progress
    rows: list[FleetRow] = field(default_factory=list)
    """The fleets of the first seed."""

    def write(self, writer: RunWriter) -> None:
        knee = self.run()
        writer.update(service={self.cell: self.service.about})
        writer.append(FLEETS, self.rows)
        writer.append(KNEES, [] if knee is None else [knee])

    def run(self) -> KneeRow | None:
        """Try one robot, then fleets as `search`; return the median knee of `SEEDS` seeds.

        It has no interval: how rare service times are is not seen in those of one robot.
        """
        plan, limit, first, knees = self.search, self.search.limit, self.load.seed, []
        for seed in range(first, first + (1 if limit is None else SEEDS)):
            self.progress.stage(f"{self.cell}: in virtual time, seed {seed}")
            tried: dict[int, Tried] = {}
            judge = Judge(limit, self.load.beyond_alone(limit), self.load.settle_ns, LEVEL)
            search(plan.numbers, partial(self._attempt, judge, seed), tried, bisects=plan.bisects)
            knees += [each for each in (knee(tried.values()),) if each]
        if limit is None:
            return None
        median = sorted(knees, key=lambda each: each.robots)[len(knees) // 2]
        text = self.load.limit_text(limit)
        return KneeRow(self.cell, "predicted", text, median.robots, median.robots, median.high, None)

    def _attempt(self, judge: Judge, seed: int, robots: int) -> Tried:
        load, service, look_ns = self.load, self.service, self.search.look_ns
        span_ns = look_ns + (0 if load.episode_ns else load.settle_ns)
        self._check(robots, span_ns)
        times = service.times(generator(seed, "capacity service", str(robots)))
        rng = generator(seed, "capacity phases")
        traces = simulate(load, span_ns, robots, times, rng, service.servers, service.slower)
        metrics = measures(traces, load.setting, load.settle_ns)
        verdict, within = judge(metrics, traces, first=robots == 1)
        if seed == load.seed:
            fleet = FleetRow(
                cell=self.cell,
                source="predicted",
                robots=robots,
                seconds=look_ns / 1e9,
                looks=1,
                verdict=verdict,
                within=within,
                clean=True,
                **vars(replace(metrics, stalled_alone=judge.alone)),
            )
            self.rows.append(fleet)
        if judge.limit and getattr(metrics, judge.limit.column) is not None:  # what is computed is taken as sure
            verdict = "below" if within else "above"
        return Tried(robots, verdict, within)

    def _check(self, robots: int, span_ns: int) -> None:
        """Raise UsageError for more ticks or requests than are kept in memory."""
        service = self.service
        if self.load.mode is None:
            rate = service.servers * len(service.slower) / service.slower[-1] / service.mean_ns
        else:
            rate = robots / self.load.setting.period_ns
        if rate * span_ns > MOST:
            raise UsageError(
                f"`seconds`: {robots} robots for {span_ns / 1e9:g} s are over {MOST:.0e} ticks or requests, "
                "which are held in memory; take fewer"
            )


@contextmanager
def _named(field: str) -> Iterator[None]:
    """Name the field in errors about latencies."""
    try:
        yield
    except UsageError as error:
        raise UsageError(str(error).replace("`latency`", f"`{field}`")) from error
