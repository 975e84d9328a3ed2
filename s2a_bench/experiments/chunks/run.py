"""The run of chunks in virtual time: every mode and rule under the same latencies."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.errors import UsageError
from s2a_bench.experiments.chunks.cells import Cell, Drawn, cells, draw
from s2a_bench.experiments.chunks.config import ChunksConfig
from s2a_bench.experiments.chunks.delays import delay_rows, write_delays
from s2a_bench.experiments.chunks.rows import CHUNKS, REACTIONS, REQUESTS, SMOOTHNESS, STABILITY, TICKS, TRIGGERS
from s2a_bench.experiments.chunks.smooth import Follower, follower, smoothness_rows
from s2a_bench.experiments.chunks.to_rows import chunk_row, reaction_rows, reactions_s, request_rows, tick_rows
from s2a_bench.experiments.chunks.varying import stability_rows, trigger_rows
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.machine import environment
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.progress import Progress

MOST_TICKS = 100_000_000
"""Control ticks of a cell: they are held in memory."""


def run_chunks(config: ChunksConfig, output: Path, progress: Progress) -> Path:
    """Simulate every cell, or act live, and return the run folder; raises S2AError for what a user can mend."""
    if config.live:
        from s2a_bench.experiments.chunks.live.run import run_live

        return run_live(config, output, progress)
    drawn = [draw(config, source) for source in config.sources]
    for each in drawn:
        _check(config, each)
    tried = [cell for each in drawn for cell in cells(config, each)]
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"latencies": config.seed},
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
            _simulate(config, cell, follows, writer)
            progress.advance()
        for each in drawn:
            writer.append(TRIGGERS, trigger_rows(config, each))
        writer.append(STABILITY, stability_rows(config, drawn[0]))
        writer.append(SMOOTHNESS, smoothness_rows(config, drawn[0], follows))
        if config.export_delays is not None:
            write_delays(config.export_delays, delay_rows(drawn[0], tried[0].mode, config.setting))
        return writer.path


def _simulate(config: ChunksConfig, cell: Cell, follows: Follower | None, writer: RunWriter) -> None:
    setting, latency_ns = config.setting.slowed(cell.slower), cell.drawn.judged
    cycles, ticks = cell.mode.cycles(latency_ns, setting), cell.mode.ticks(latency_ns, setting)
    reaction_s = reactions_s(cycles, ticks, setting, generator(config.seed, "chunks events"))
    smooth = follows.measure(cell.mode, cycles, ticks) if follows and cell.slower == 1 else {}
    row = chunk_row(cell, setting, cycles, ticks, epsilon=config.epsilon, reaction_s=reaction_s, smooth=smooth)
    writer.append(CHUNKS, [row])
    writer.append(REACTIONS, reaction_rows(cell, latency_ns, setting, reaction_s))
    writer.append(TICKS, tick_rows(cell.cell, ticks, config.shown_ticks))
    writer.append(REQUESTS, request_rows(cell.cell, latency_ns, cycles, config.shown_ticks))


def _check(config: ChunksConfig, drawn: Drawn) -> None:
    """Refuse what would not fit into memory."""
    ticks = int(drawn.judged.size) * config.horizon + int(config.setting.known_ticks(drawn.judged).sum())
    if ticks > MOST_TICKS:
        raise UsageError(
            f"`cycles`: {drawn.judged.size} chunks @ {drawn.source.name} make {ticks:.2g} control ticks, more than "
            f"{MOST_TICKS:.0e}; take fewer, or a lower `control_hz`"
        )
