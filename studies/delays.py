"""What a trigger keeps, and costs, where delays of chunks are not exchangeable with those of its calibration.

Latencies of 60 ms in the mean: independent, autoregressive, of two Markov states (MMPP), or longer from the first cycle
after the calibration. `calibrated` keeps its trigger, `tracked` and `maximum` learn from every cycle, and `hindsight`
is the least fixed trigger that keeps epsilon in the judged cycles themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from s2a_bench.boards.gaps import Markov
from s2a_bench.machine import environment
from s2a_bench.options import Options, option
from s2a_bench.plugins.chunks.modes import ControlSetting, Ints, mode
from s2a_bench.plugins.chunks.modes.metrics import measure
from s2a_bench.plugins.chunks.modes.trigger import Maximum, calibrate, follow, trigger
from s2a_bench.policy.conformal import GUARANTEE, Guarantee, Tracker
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.stats.batches import Rows
from s2a_bench.stats.change import change_of_ranks
from s2a_bench.stats.seeds import generator
from s2a_bench.store.run import RunWriter
from s2a_bench.store.schema import Table
from s2a_bench.writers.csv_text import CsvTable
from s2a_bench.writers.tables import DRAWN, Note, TextTable
from studies import output

if TYPE_CHECKING:
    from s2a_bench.policy import Floats
    from s2a_bench.progress import Progress
    from s2a_bench.store.run import StoredRun

MEAN_S: Final = 0.06
CV: Final = 0.5
STEP: Final = 1.5
LEVEL: Final = 0.01
SETTING: Final = ControlSetting(period_ns=20_000_000, horizon=16)
MOST: Final = SETTING.horizon - 1

Process: TypeAlias = "Callable[[np.random.Generator, int], Floats]"


def _autoregressive(rng: np.random.Generator, count: int, *, phi: float) -> Floats:
    """Draw lognormal latencies in s, whose logarithms are an autoregressive series of order 1."""
    noise = rng.standard_normal(count) * (1 - phi**2) ** 0.5
    level, found = rng.standard_normal(), np.empty(count)
    for place, each in enumerate(noise.tolist()):
        level = phi * level + each
        found[place] = level
    variance = np.log1p(CV**2)
    latency_s: Floats = MEAN_S * np.exp(variance**0.5 * found - variance / 2)
    return latency_s


def _two_states(rng: np.random.Generator, count: int) -> Floats:
    """Draw latencies of which one in ten is 2.5 times as long, in stretches of 50."""
    return Markov(MEAN_S, 0.3, pause_share=0.1, pause_ratio=2.5, pause_tokens=50.0).sample(rng, count, 1)[:, 0]


PROCESSES: Final[dict[str, tuple[Process, float]]] = {
    "independent": (partial(_autoregressive, phi=0.0), 1.0),
    "AR(0.9)": (partial(_autoregressive, phi=0.9), 1.0),
    "AR(0.99)": (partial(_autoregressive, phi=0.99), 1.0),
    "MMPP": (_two_states, 1.0),
    f"step x {STEP:g}": (partial(_autoregressive, phi=0.0), STEP),
}
"""Latencies, and by what they are longer after the calibration."""


class DelaysConfig(Options):
    """On how many cycles."""

    cycles: int = option(4000, "cycles that are judged", ge=2, le=1_000_000)
    calibration_cycles: int = option(400, "cycles before them, which rules learn from", ge=1, le=1_000_000)
    epsilon: float = option(0.01, "share of cycles that may stall", gt=0, lt=1)
    guarantee: Guarantee = GUARANTEE
    seed: int = option(0, "seed; every cell has its own from it", ge=0)
    seeds: int = option(20, "as many seeds, this and the following ones", ge=1, le=1000)


@dataclass(frozen=True, slots=True)
class DelayRow:
    """One rule under one process; ``trigger`` is its mean, ages are in ticks of 20 ms.

    ``correlated`` is True where the lag-1 correlation of the calibration withdraws its promise, ``changed`` where the
    judged delays differ from the calibration's by a rank test on the 1 % level.
    """

    process: str
    rule: str
    seed: int
    p_stall: float
    trigger: float
    age_ticks: float
    correlated: bool
    changed: bool


DELAYS: Final[Table[DelayRow]] = Table("delays", DelayRow)


def rows(config: DelaysConfig, process: str, seed: int) -> Iterator[DelayRow]:
    """Yield a row a rule, all on the same latencies."""
    draw, longer = PROCESSES[process]
    count = config.calibration_cycles
    latency_s = draw(generator(seed, "delays", process), count + config.cycles)
    latency_s[count:] *= longer
    learnt, judged = np.split(np.rint(latency_s * 1e9).astype(np.int64), [count])
    known = calibrate(learnt, config.epsilon, config.guarantee)
    maximum = Maximum(float(learnt.max()))
    hindsight = int(np.sort(judged)[-1 - int(config.epsilon * judged.size)])
    ticks = [Rows(SETTING.delay_ticks(each).astype(float)) for each in (learnt, judged)]
    change = change_of_ranks(*ticks)
    chosen: dict[str, Ints] = {
        "calibrated": np.array([trigger(known.caution, SETTING, MOST).ticks]),
        "tracked": follow(Tracker(learnt.tolist(), config.epsilon), judged, SETTING, MOST),
        "maximum": follow(maximum, judged, SETTING, MOST),
        "hindsight": np.array([trigger(hindsight, SETTING, MOST).ticks]),
    }
    for rule, triggers in chosen.items():
        queue = mode("queue").varied(tuple(triggers.tolist()))
        found = measure(queue, queue.cycles(judged, SETTING), queue.ticks(judged, SETTING))
        yield DelayRow(
            process=process,
            rule=rule,
            seed=seed,
            p_stall=found.p_stall_cycle,
            trigger=float(triggers.mean()),
            age_ticks=found.age_ticks_mean,
            correlated=not known.exchangeable,
            changed=change.p is not None and change.p < LEVEL,
        )


def run_delays(config: DelaysConfig, folder: Path, progress: Progress) -> Path:
    """Run the study and return its run folder."""
    manifest = {
        "configuration": {"study": "delays", **config.model_dump()},
        "environment": environment.collect(),
        "seeds": {"study": config.seed},
        "provenance": Origins(Provenance.computed()).to_manifest(),
        "warnings": [],
    }
    with RunWriter.create(folder, "study-delays", manifest, (DELAYS,)) as writer:
        progress.opened(writer.path)
        progress.expect(len(PROCESSES) * config.seeds)
        for process in PROCESSES:
            progress.stage(process)
            for seed in range(config.seed, config.seed + config.seeds):
                writer.append(DELAYS, rows(config, process, seed))
                progress.advance()
        return writer.path


def delay_table(run: StoredRun) -> TextTable:
    """Return the table of the rules under each process: means over the seeds, and their range."""
    config = run.manifest["configuration"]
    groups = []
    for process, part in run.table(DELAYS).groupby("process", sort=False):
        doubts = tuple(f"{part[name].mean():.0%}" for name in ("correlated", "changed"))
        group = []
        for rule, mine in part.groupby("rule", sort=False):
            stalls = mine["p_stall"]
            share = f"{stalls.mean():.2%} [{stalls.min() * 100:.2f}, {stalls.max() * 100:.2f}]"
            numbers = (f"{mine[name].mean():.1f}" for name in ("trigger", "age_ticks"))
            group.append((str(process), str(rule), share, *numbers, *(doubts if rule == "calibrated" else ("", ""))))
        groups.append(group)
    header = ("delays", "rule", "P(stall)", "trigger", "age", "correlated", "changed")
    notes = (
        Note(
            f"{config['cycles']} cycles after {config['calibration_cycles']} of calibration, {config['seeds']} seeds: "
            "mean [range]. Latencies are drawn; nothing here is measured.",
            DRAWN,
        ),
        "age: of the observation behind an action, in ticks.",
        "correlated, changed: share of the seeds in which lag-1 correlation, or a rank test, withdraws the promise.",
    )
    return TextTable.grouped("Triggers where delays are not exchangeable", header, groups, 2, notes, once=1)


def show_delays(run: StoredRun) -> None:
    """Write and print the table of the study."""
    output.show(run, {"delays": delay_table(run)}, {"delays.csv": CsvTable.of_frame(run.table(DELAYS))}, {})
