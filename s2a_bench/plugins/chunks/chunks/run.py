"""The run of chunks in virtual time: modes and rules under the same latencies, varied triggers and mean latencies."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from s2a_bench.plugins.chunks.chunks.build_rows import ActedCell, cell_rows, mean_rows, trigger_rows
from s2a_bench.plugins.chunks.chunks.plan import resolve
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, MEANS, REACTIONS, REQUESTS, TICKS, TRIGGERS
from s2a_bench.plugins.chunks.latencies import delay_rows, write_delays
from s2a_bench.store.run import RunWriter

if TYPE_CHECKING:
    from s2a_bench.plugins.chunks.chunks.cells import ChunkCell
    from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
    from s2a_bench.plugins.chunks.chunks.smooth import TrackingPlant
    from s2a_bench.plugins.chunks.modes import ControlSetting
    from s2a_bench.progress import Progress


def run_virtual(config: ChunksVirtual, output: Path, progress: Progress) -> Path:
    """Act in virtual time and return the run folder; raises S2AError."""
    plan = resolve(config)
    setting, mode, first = plan.control.setting, plan.rules.mode, plan.drawn[0]
    with RunWriter.create(output, "chunks", plan.manifest, (CHUNKS, REACTIONS, TICKS, REQUESTS)) as writer:
        progress.opened(writer.path)
        progress.stage("acting in virtual time")
        progress.expect(len(plan.cells))
        for cell in plan.cells:
            acted = _acted(cell, setting.slowed(cell.slower), plan.follows)
            for table, rows in cell_rows(acted, plan.shown_ticks, plan.rules.epsilon, plan.control.seed).items():
                writer.append(table, rows)
            progress.advance()
        if mode is not None:
            for drawn in plan.drawn:
                writer.append(TRIGGERS, trigger_rows(mode, setting, drawn))
        writer.append(MEANS, mean_rows(plan.control, first, plan.follows))
        if plan.export_delays is not None:
            write_delays(plan.export_delays, delay_rows(first.source, first.judged, plan.cells[0].mode, setting))
        return writer.path


def _acted(cell: ChunkCell, setting: ControlSetting, follows: TrackingPlant | None) -> ActedCell:
    mode, latency_ns = cell.acting, cell.drawn.judged
    cycles, ticks = mode.cycles(latency_ns, setting), mode.ticks(latency_ns, setting)
    smooth = follows.measure(cell.mode, cycles, ticks) if follows and cell.slower == 1 else {}
    return ActedCell(cell, setting, cycles, ticks, smooth)
