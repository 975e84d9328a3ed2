"""The run of chunks in virtual time: modes and rules under the same latencies, varied triggers and mean latencies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.errors import UsageError
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.machine import environment
from s2a_bench.plugins.chunks.chunks.build_rows import stalls_of, write_cell
from s2a_bench.plugins.chunks.chunks.cells import (
    FOLLOW,
    LatencyDraw,
    cells,
    changes,
    draw,
    without_trigger,
)
from s2a_bench.plugins.chunks.chunks.config import PROMISING, ChunksConfig
from s2a_bench.plugins.chunks.chunks.rows import (
    CHUNKS,
    MEANS,
    REACTIONS,
    REQUESTS,
    TICKS,
    TRIGGERS,
    MeanRow,
    TriggerRow,
)
from s2a_bench.plugins.chunks.chunks.smooth import TrackingPlant, follower
from s2a_bench.plugins.chunks.latencies import delay_rows, write_delays
from s2a_bench.plugins.chunks.modes.closed import closed
from s2a_bench.plugins.chunks.modes.metrics import measure
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.plugins.chunks.modes import Cycles
    from s2a_bench.progress import Progress

MOST_POINTS: Final = 64
MEANS_TRIED: Final = 33
REQUESTS_TRIED: Final = 2000
SMOOTH: Final = ("tracking_rms", "tracking_rms_ideal", "jerk_rms", "jerk_rms_ideal")


def trigger_rows(config: ChunksConfig, drawn: LatencyDraw) -> Iterator[TriggerRow]:
    """Yield a row for every trigger of the first mode that has one."""
    if config.triggered is None:
        return
    setting = config.setting
    length = config.triggered.execution_horizon(setting)
    for trigger in np.unique(np.linspace(0, length - 1, min(length, MOST_POINTS)).round()).astype(int).tolist():
        mode = config.triggered.varied((trigger,))
        cycles = mode.cycles(drawn.judged, setting)
        found = stalls_of(cycles)
        del found["stalled_cycles"]
        if found["boundaries"]:
            yield TriggerRow(
                latency=drawn.source.name,
                mode=without_trigger(mode),
                execution_horizon=length,
                trigger=trigger,
                **found,
                p_stall_closed=closed(mode, drawn.judged, setting).p_stall,
                age_ticks_mean=mean_age(cycles),
            )


def mean_rows(config: ChunksConfig, drawn: LatencyDraw, follows: TrackingPlant | None) -> Iterator[MeanRow]:
    """Yield a row for each mode under the source's latencies scaled to means from 0 to H ticks."""
    setting, judged = config.setting, drawn.judged[:REQUESTS_TRIED]
    shape = judged / max(float(judged.mean()), 1.0)
    for mean_ns in np.linspace(0, setting.horizon * setting.period_ns, MEANS_TRIED):
        latency_ns = np.rint(shape * mean_ns).astype(np.int64)
        for name, mode in config.control.modes.items():
            cycles, ticks = mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting)
            share = measure(mode, cycles, ticks).stall_share
            smooth = follows.measure(mode, cycles, ticks) if follows else {}
            yield MeanRow(
                latency=drawn.source.name,
                mode=name,
                latency_s=mean_ns / 1e9,
                stall_share=None if np.isnan(share) else share,
                **{each: smooth.get(each) for each in SMOOTH},
            )


def mean_age(cycles: Cycles) -> float:
    """Return the mean age of the observation in ticks over executed actions; each chunk is executed in one run."""
    middle = cycles.start_tick - cycles.request_tick + (cycles.executed - 1) / 2
    return float(np.average(middle, weights=cycles.executed))


MOST_TICKS = 100_000_000
"""Control ticks of a cell, which are held in memory."""


def run_chunks(config: ChunksConfig, output: Path, progress: Progress) -> Path:
    if config.live:
        from s2a_bench.plugins.chunks.chunks.live import run_live

        return run_live(config, output, progress)
    drawn = [draw(config, source) for source in config.sources]
    for each in drawn:
        _check(config, each)
    tried = [cell for each in drawn for cell in cells(config, each)]
    found = {cell.drawn.source.name: asdict(cell.calibration) for cell in tried if cell.calibration}
    warnings = [*_warnings(config), *exchange_warnings(found, FOLLOW)]
    for name, each in {cell.drawn.source.name: cell.drawn for cell in tried if cell.rule in PROMISING}.items():
        if each.source.recorded_ns is not None and (changed := changes(config, name, each.learnt, each.judged)):
            warnings += changed
            found.get(name, {})["changed"] = True
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"latencies": config.seed},
        "calibrations": found,
        "warnings": [warning.to_manifest() for warning in warnings],
        "provenance": Origins(
            Provenance.computed(), {cell.cell: cell.drawn.source.provenance for cell in tried}
        ).to_manifest(),
    }
    with RunWriter.create(output, "chunks", manifest, (CHUNKS, REACTIONS, TICKS, REQUESTS)) as writer:
        progress.opened(writer.path)
        progress.stage("acting in virtual time")
        progress.expect(len(tried))
        follows = follower(config)
        for cell in tried:
            setting, latency_ns = config.setting.slowed(cell.slower), cell.drawn.judged
            cycles, ticks = cell.acting.cycles(latency_ns, setting), cell.acting.ticks(latency_ns, setting)
            smooth = follows.measure(cell.mode, cycles, ticks) if follows and cell.slower == 1 else {}
            write_cell(config, writer, cell, cycles, ticks, config.shown_ticks, more=smooth)
            progress.advance()
        for each in drawn:
            writer.append(TRIGGERS, trigger_rows(config, each))
        writer.append(MEANS, mean_rows(config, drawn[0], follows))
        if config.export_delays is not None:
            write_delays(
                config.export_delays, delay_rows(drawn[0].source, drawn[0].judged, tried[0].mode, config.setting)
            )
        return writer.path


def _warnings(config: ChunksConfig) -> Iterator[RunWarning]:
    if missing := ", ".join(rule for rule in config.rules if config.with_rules and rule not in config.rules_tried):
        yield RunWarning(
            "few-latencies", f"without the rules {missing}: {config.too_few}", "record more, or raise --eps"
        )


def _check(config: ChunksConfig, drawn: LatencyDraw) -> None:
    ticks = int(drawn.judged.size) * config.horizon + int(config.setting.known_ticks(drawn.judged).sum())
    if ticks > MOST_TICKS:
        raise UsageError(
            f"`cycles`: {drawn.judged.size} chunks @ {drawn.source.name} make {ticks:.2g} control ticks, more than "
            f"{MOST_TICKS:.0e}; take fewer, or a lower `control_hz`"
        )
