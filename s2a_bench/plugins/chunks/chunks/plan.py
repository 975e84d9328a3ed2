"""The plan of a run of chunks in virtual time: its latencies, its cells, and what rules learned for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from s2a_bench.errors import UsageError
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.machine import environment
from s2a_bench.plugins.chunks.chunks.cells import FOLLOW, ChunkCell, LatencyDraw, cells, changes, draw
from s2a_bench.plugins.chunks.chunks.config import PROMISING, RulesPlan
from s2a_bench.plugins.chunks.chunks.smooth import TrackingPlant, follower
from s2a_bench.provenance import Origins, Provenance
from s2a_bench.store.manifest import RunWarning

if TYPE_CHECKING:
    from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
    from s2a_bench.plugins.chunks.modes import ControlSetting
    from s2a_bench.plugins.chunks.options import ControlPlan

MOST_TICKS: Final = 100_000_000
"""Control ticks of a cell, which are held in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class VirtualPlan:
    """A run in virtual time."""

    control: ControlPlan
    rules: RulesPlan
    drawn: Sequence[LatencyDraw]
    """Of each source."""
    cells: Sequence[ChunkCell]
    follows: TrackingPlant | None
    """The robot and its target; None without a robot, or with actions slowed down."""
    shown_ticks: int
    export_delays: Path | None
    manifest: dict[str, Any]


def resolve(config: ChunksVirtual) -> VirtualPlan:
    """Draw the latencies, have the rules learn, and decide what follows; raises S2AError."""
    control, rules, setting = config.control, config.rules_plan, config.setting
    drawn = [draw(source, config.cycles, config.learnt, config.seed) for source in config.sources]
    for each in drawn:
        _check_memory(each, setting)
    tried = [cell.followed(setting) for each in drawn for cell in cells(control, rules, each)]
    calibrations = {cell.drawn.source.name: asdict(cell.calibration) for cell in tried if cell.calibration}
    warnings = exchange_warnings(calibrations, FOLLOW)
    if config.learnt and (missing := ", ".join(rule for rule in config.rules if rule not in rules.tried)):
        few = f"without the rules {missing}: {config.too_few}"
        warnings = [RunWarning("few-latencies", few, "record more, or raise --eps"), *warnings]
    for each in {cell.drawn.source.name: cell.drawn for cell in tried if cell.rule in PROMISING}.values():
        name, recorded = each.source.name, each.source.recorded_ns is not None
        if recorded and (changed := changes(setting, name, each)):
            warnings += changed
            calibrations.get(name, {})["changed"] = True
    manifest = {
        "configuration": config.to_manifest(),
        "environment": environment.collect(),
        "seeds": {"latencies": config.seed},
        "calibrations": calibrations,
        "warnings": [warning.to_manifest() for warning in warnings],
        "provenance": Origins(
            Provenance.computed(), {cell.cell: cell.drawn.source.provenance for cell in tried}
        ).to_manifest(),
    }
    plant = config.robot_kind if config.slow_down == 1 else None
    follows = None if plant is None else follower(plant, control)
    return VirtualPlan(control, rules, drawn, tried, follows, config.shown_ticks, config.export_delays, manifest)


def _check_memory(drawn: LatencyDraw, setting: ControlSetting) -> None:
    """Raise UsageError for latencies of more ticks than are held in memory."""
    ticks = int(drawn.judged.size) * setting.horizon + int(setting.known_ticks(drawn.judged).sum())
    if ticks > MOST_TICKS:
        raise UsageError(
            f"`cycles`: {drawn.judged.size} chunks @ {drawn.source.name} make {ticks:.2g} control ticks, more than "
            f"{MOST_TICKS:.0e}; take fewer, or a lower `control_hz`"
        )
