"""What a mode did live, as rows: judged with the formulas of virtual time, on the latencies that were measured.

A latency counts from the start of the tick in which a request left until its chunk was there.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from s2a_bench.errors import TransportError
from s2a_bench.experiments.chunks.cells import Cell
from s2a_bench.experiments.chunks.rows import CHUNKS, REACTIONS, REQUESTS, TICKS
from s2a_bench.experiments.chunks.smooth import MOST_TICKS
from s2a_bench.experiments.chunks.to_rows import (
    chunk_row,
    interval,
    reaction_rows,
    reactions_s,
    request_rows,
    tick_rows,
)
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.harness.rounds import keep_origin
from s2a_bench.policy.chunks.cycles import gather
from s2a_bench.policy.chunks.learning import Learning
from s2a_bench.policy.chunks.stepping import NEVER, follow
from s2a_bench.policy.chunks.varied import Varied
from s2a_bench.robots.plant import PlantRobot
from s2a_bench.robots.smoothness import smoothness

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.experiments.chunks.live.asking import Asking
    from s2a_bench.experiments.chunks.rows import AboutCell
    from s2a_bench.harness.session import Session
    from s2a_bench.policy.chunks import Cycles, Setting, Ticks
    from s2a_bench.robots import Robot
    from s2a_bench.runtime.control import Acted
    from s2a_bench.store.run import RunWriter

SMOOTH: Final = ("jerk_rms", "boundary_jump_mean", "boundary_jump_p99", "action_step_mean")
"""What is told of how a plant moved: nobody knows what the policy follows."""


@dataclass(frozen=True, slots=True, eq=False)
class Live:
    """What a mode did over a pipeline; ``triggers`` are those that a rule chose as it went."""

    cell: Cell
    setting: Setting
    session: Session
    acted: Acted
    asking: Asking
    robot: Robot | None
    triggers: tuple[int, ...] = ()

    @property
    def judged(self) -> Cell:
        """Return the cell with the latencies that it had, of whole answers, and the triggers."""
        latency_ns = self.acted.arrival_ns[: self.acted.whole, 0 if self.cell.mode.streams else -1]
        cell = replace(self.cell, drawn=replace(self.cell.drawn, judged=latency_ns))
        if not isinstance(cell.mode, Learning):
            return cell
        triggers = self.triggers[: latency_ns.size]
        return replace(cell, mode=Varied(triggers, cell.mode.execute), triggers=triggers)

    def counted(self) -> tuple[Cycles, Ticks]:
        """Return what it did in all of its ticks; an answer that never came is usable behind the last of them."""
        acted, ticks = self.acted, self.acted.chunk.size
        arrival_ns = acted.arrival_ns[:, -1]
        delay = np.where(arrival_ns < 0, ticks, self.setting.delay_ticks(np.maximum(arrival_ns, 0)))
        return gather(acted.asked_tick, acted.asked_tick + delay, acted.chunk, acted.index, self.setting.horizon)

    def agreement(self) -> float:
        """Return the share of the ticks in which it did what virtual time says of the same arrivals."""
        acted = self.acted
        arrival_ns = np.where(acted.arrival_ns < 0, NEVER, acted.arrival_ns)
        _, said = follow(self.cell.mode, arrival_ns, self.setting, acted.chunk.size)
        both = min(said.chunk.size, acted.chunk.size)
        alike = (acted.chunk[:both] == said.chunk[:both]) & (acted.index[:both] == said.index[:both])
        return float(alike.sum()) / acted.chunk.size

    def smooth(self) -> dict[str, float]:
        """Return how smoothly a plant moved, in the actions' own unit and s; nothing of other robots."""
        if not isinstance(self.robot, PlantRobot) or (motion := self.robot.motion(MOST_TICKS)) is None:
            return {}
        first = int((self.acted.chunk >= 0).argmax())
        chunk = self.acted.chunk[first : first + MOST_TICKS]
        found = smoothness(motion, self.robot.actions[:MOST_TICKS], chunk)
        return {name: getattr(found, name) for name in SMOOTH}

    def timing(self) -> dict[str, float | int]:
        """Return the metrics that only a live run has."""
        acted, period_ns = self.acted, self.setting.period_ns
        late_s, busy_s = acted.late_ns / 1e9, acted.busy_ns / 1e9
        return {
            "agreement": self.agreement(),
            "jitter_s_p50": float(np.quantile(late_s, 0.5)),
            "jitter_s_p99": float(np.quantile(late_s, 0.99)),
            "jitter_s_max": float(late_s.max()),
            "late_ticks": int((acted.late_ns >= period_ns).sum()),
            "blocked_s_p99": float(np.quantile(busy_s, 0.99)),
            "blocked_s_max": float(busy_s.max()),
            "bytes_up_per_s": self.asking.sent_bytes / (acted.chunk.size * period_ns / 1e9),
        }


def _with_stalled_boundary(row: AboutCell) -> dict[str, Any]:
    """Return the metrics of boundaries with one more, which stalls."""
    told = asdict(row)
    boundaries, stalled = told["boundaries"] + 1, told["stalled_cycles"] + 1
    low, high = interval(stalled, boundaries)
    shares = {"p_stall_cycle": stalled / boundaries, "p_stall_low": low, "p_stall_high": high}
    return {"boundaries": boundaries, "stalled_cycles": stalled, **shares}


def write(config: ChunksConfig, writer: RunWriter, live: Live) -> None:
    """Write the rows of one mode over one pipeline; raises TransportError where too little was answered."""
    if live.acted.whole < 2:  # noqa: PLR2004 - a boundary lies between two chunks
        raise TransportError(f"{live.cell.cell}: {live.acted.whole} chunks in {config.seconds:g} s; act for longer")
    cell, setting = live.judged, live.setting
    latency_ns = cell.drawn.judged
    keep_origin(writer, cell.cell, live.session.origin)
    cycles, ticks = live.counted()
    reaction_s = reactions_s(cycles, ticks, setting, generator(config.seed, "chunks events"))
    row = chunk_row(cell, setting, cycles, ticks, epsilon=config.epsilon, reaction_s=reaction_s, smooth=live.smooth())
    if ticks.stalled.any() and ticks.stalled[-1]:  # the boundary that it waits for at the end
        row = replace(row, **_with_stalled_boundary(row))
    if cell.mode.streams:  # the closed forms are about a given gap between actions
        row = replace(row, p_stall_closed=None, reaction_s_closed=None, margin_ticks=None)  # type: ignore[call-arg]
    writer.append(CHUNKS, [replace(row, **live.timing())])  # type: ignore[arg-type]
    writer.append(REACTIONS, reaction_rows(cell, latency_ns, setting, reaction_s))
    whole = ticks.chunk.size  # what is measured is kept
    writer.append(TICKS, tick_rows(cell.cell, ticks, whole, live.acted.late_ns))
    writer.append(REQUESTS, request_rows(cell.cell, latency_ns, cycles, whole, live.asking.names))
