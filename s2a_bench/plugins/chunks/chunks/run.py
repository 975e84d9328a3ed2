"""The run of chunks in virtual time: acting modes and rules under the same latencies, varied triggers and means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.experiments.requests import span_of
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.machine import environment
from s2a_bench.plugins.chunks.chunks.build_rows import ActedCell, cell_rows, mean_rows, trigger_rows
from s2a_bench.plugins.chunks.chunks.cells import FOLLOW, ActingCell, LatencyDraw, cells, changes, draw
from s2a_bench.plugins.chunks.chunks.config import PROMISING, ChunksVirtual
from s2a_bench.plugins.chunks.chunks.rows import CHUNKS, MEANS, REACTIONS, REQUESTS, TICKS, TRIGGERS
from s2a_bench.plugins.chunks.latencies import write_delays
from s2a_bench.plugins.chunks.modes import ControlSetting
from s2a_bench.progress import Progress
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning
from s2a_bench.store.run import RunWriter

MOST_TICKS: Final = 100_000_000
"""Control ticks of a cell, which are held in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class VirtualPlan:
    """The draws of a run in virtual time, and the values derived from them."""

    latencies: Sequence[LatencyDraw]
    """The draws of each source."""
    cells: Sequence[ActingCell]
    manifest: dict[str, Any]


def resolve(config: ChunksVirtual) -> VirtualPlan:
    """Draw the latencies, have the rules learn, and decide what follows; raises S2AError."""
    control, rules, setting = config.control, config.rules_plan, config.setting
    latencies = [draw(source, config.cycles, config.learnt, config.seed) for source in config.sources]
    for each in latencies:
        _check_memory(each, setting)
    tried = [cell.followed(setting) for each in latencies for cell in cells(control, rules, each)]
    calibrations = {cell.latencies.source.name: asdict(cell.calibration) for cell in tried if cell.calibration}
    warnings = exchange_warnings(calibrations, FOLLOW)
    if config.learnt and (missing := ", ".join(rule for rule in config.rules if rule not in rules.tried)):
        few = f"without the rules {missing}: {config.too_few}"
        warnings = [RunWarning("few-latencies", few, "record more, or raise --eps"), *warnings]
    for source in config.sources:
        if source.horizons and source.horizons != (setting.horizon,):
            about = f"answers of {source.name} have {span_of(source.horizons)} actions, not {setting.horizon}"
            warnings.append(RunWarning("other-horizon", about, "set --horizon, and --control-hz, to the policy's"))
    for each in {cell.latencies.source.name: cell.latencies for cell in tried if cell.rule in PROMISING}.values():
        name, recorded = each.source.name, each.source.recorded_ns is not None
        if recorded and (changed := changes(setting, name, each)):
            warnings += changed
            calibrations.get(name, {})["changed"] = True
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"latencies": config.seed},
        "calibrations": calibrations,
        "warnings": warnings,
        "provenance": Origins(
            Provenance.computed(), {cell.cell: cell.latencies.source.provenance for cell in tried}
        ).to_manifest(),
    }
    return VirtualPlan(latencies, tried, manifest)


def _check_memory(latencies: LatencyDraw, setting: ControlSetting) -> None:
    """Raise UsageError for latencies of more ticks than are held in memory."""
    ticks = int(latencies.judged.size) * setting.horizon + int(setting.known_ticks(latencies.judged).sum())
    if ticks > MOST_TICKS:
        raise UsageError(
            f"`cycles`: {latencies.judged.size} chunks @ {latencies.source.name} make {ticks:.2g} control ticks, more "
            f"than {MOST_TICKS:.0e}; take fewer, or a lower `control_hz`"
        )


def run_virtual(config: ChunksVirtual, output: Path, progress: Progress) -> Path:
    """Act in virtual time and return the run folder; raises S2AError."""
    plan = resolve(config)
    setting, mode, first = config.control.setting, config.rules_plan.mode, plan.latencies[0]
    with RunWriter.create(output, "chunks", plan.manifest, (CHUNKS, REACTIONS, TICKS, REQUESTS)) as writer:
        progress.opened(writer.path)
        progress.stage("acting in virtual time")
        progress.expect(len(plan.cells))
        for cell in plan.cells:
            acting, latency_ns, slowed = cell.acting, cell.latencies.judged, setting.slowed(cell.slower)
            acted = ActedCell(cell, slowed, acting.cycles(latency_ns, slowed), acting.ticks(latency_ns, slowed))
            for table, rows in cell_rows(acted, config.shown_ticks, config.epsilon, config.seed).items():
                writer.append(table, rows)
            progress.advance()
        if mode is not None:
            for latencies in plan.latencies:
                writer.append(TRIGGERS, trigger_rows(mode, setting, latencies))
        writer.append(MEANS, mean_rows(config.control, first))
        if config.export_delays is not None:
            write_delays(config.export_delays, first.source, first.judged, plan.cells[0].mode, setting)
        return writer.path
