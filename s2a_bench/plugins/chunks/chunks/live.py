"""The live run: every acting mode runs at control rate on a server's answers; the metrics are those of virtual time.

A latency counts from the start of the tick of a request until its chunk is complete.
"""

from __future__ import annotations

from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import count, groupby
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from s2a_bench.errors import TransportError
from s2a_bench.harness.rounds import RunningLaunch, Task, keep_origin, run_requests
from s2a_bench.harness.session import Session
from s2a_bench.harness.warnings import exchange_warnings
from s2a_bench.plugins.chunks.acting import act, clients_of, plan_of, warm_up
from s2a_bench.plugins.chunks.chunks.build_rows import ActedCell, cell_rows, stall_metrics, stalls_of
from s2a_bench.plugins.chunks.chunks.cells import FOLLOW, ActingCell, LatencyDraw, cells, changes
from s2a_bench.plugins.chunks.chunks.config import PROMISING, ChunksLive
from s2a_bench.plugins.chunks.control import Acted
from s2a_bench.plugins.chunks.latencies import Source, measured, write_delays
from s2a_bench.plugins.chunks.modes import ControlSetting, Cycles, Ticks
from s2a_bench.plugins.chunks.modes.cycles import gather, lay
from s2a_bench.plugins.chunks.requester import ChunkRequester
from s2a_bench.progress import Progress


@dataclass(frozen=True, slots=True, eq=False)
class LiveResult:
    """The actions of an acting mode over a pipeline; ``triggers`` are those that its rule chose."""

    cell: ActingCell
    setting: ControlSetting
    acted: Acted
    requester: ChunkRequester
    triggers: tuple[int, ...] = ()

    def counted(self) -> tuple[Cycles, Ticks]:
        """Return cycles and ticks of the whole run; a missing answer is usable after the last tick."""
        acted, ticks = self.acted, self.acted.chunk.size
        arrival_ns = acted.arrival_ns[:, 0]
        delay = np.where(arrival_ns < 0, ticks, self.setting.delay_ticks(np.maximum(arrival_ns, 0)))
        return gather(acted.request_tick, acted.request_tick + delay, acted.chunk, acted.index, self.setting.horizon)

    def agreement(self, done: Ticks) -> float | None:
        """Return the share of the ticks ``done`` that equal those of `Mode.arrays`; None without these.

        The loop runs the mode's stepper, and the arrays do not. Both have the triggers that a rule chose.
        """
        arrival_ns, ticks = self.acted.arrival_ns, self.acted.chunk.size
        end_ns = ticks * self.setting.period_ns
        arrival_ns = np.where((arrival_ns < 0) | (arrival_ns > end_ns), end_ns, arrival_ns)
        cycles = self.cell.with_triggers(self.triggers).acting.arrays(arrival_ns, self.setting)
        if cycles is None:
            return None
        computed = lay(cycles)
        length = min(computed.chunk.size, ticks)
        equal = [getattr(computed, each)[:length] == getattr(done, each)[:length] for each in ("chunk", "index", "age")]
        return float(np.all(equal, axis=0).sum()) / ticks

    def timing(self) -> dict[str, float]:
        acted, period_ns = self.acted, self.setting.period_ns
        late_s, busy_s = acted.late_ns / 1e9, acted.busy_ns / 1e9
        return {
            "jitter_s_p50": float(np.quantile(late_s, 0.5)),
            "jitter_s_p99": float(np.quantile(late_s, 0.99)),
            "jitter_s_max": float(late_s.max()),
            "late_ticks": int((acted.late_ns >= period_ns).sum()),
            "blocked_s_p99": float(np.quantile(busy_s, 0.99)),
            "blocked_s_max": float(busy_s.max()),
            "bytes_up_per_s": self.requester.sent_bytes / (acted.chunk.size * period_ns / 1e9),
        }

    def actions(self) -> ActedCell:
        """Return the actions of the cell, with the latencies of complete answers, to their first action.

        Raises TransportError for fewer than two chunks.
        """
        latency_ns = self.acted.arrival_ns[: self.acted.whole, 0]
        if latency_ns.size < 2:  # noqa: PLR2004 - a boundary lies between two chunks
            seconds = self.acted.chunk.size * self.setting.period_ns / 1e9
            raise TransportError(f"{self.cell.cell}: {latency_ns.size} chunks in {seconds:g} s; act for longer")
        judged = replace(self.cell, latencies=replace(self.cell.latencies, judged=latency_ns))
        cycles, ticks = self.counted()
        more: dict[str, Any] = {"agreement": self.agreement(ticks), **self.timing()}
        if ticks.stalled.any() and ticks.stalled[-1]:  # the run ends while it waits at a boundary
            stalls = stalls_of(cycles)
            more |= stall_metrics(stalls["stalled_cycles"] + 1, stalls["boundaries"] + 1)
        if self.cell.mode.streams:  # the closed forms are about a given gap between actions
            more |= dict.fromkeys(("p_stall_closed", "reaction_s_closed", "margin_ticks"))
        judged = judged.with_triggers(self.triggers[: latency_ns.size])
        return ActedCell(judged, self.setting, cycles, ticks, more, self.acted.late_ns, self.requester.names)


def run_live(config: ChunksLive, output: Path, progress: Progress) -> Path:
    """Act and return the run folder; raises S2AError."""
    plan = plan_of(config, f"a control loop at {config.control_hz:g} Hz", progress)
    task = Task("chunks", drive=partial(_drive, config), clients=clients_of(config.control))
    folder = run_requests(task, plan, output, progress)
    if config.export_delays is not None:
        mode = next(iter(config.control.modes.values()))
        write_delays(config.export_delays, next(measured(folder)), np.empty(0, np.int64), mode, config.setting)
    return folder


def _drive(config: ChunksLive, launch: RunningLaunch) -> None:
    blocks, control, rules, kind = count(), config.control, config.rules_plan, config.robot_kind
    tried: list[tuple[ActingCell, list[Session], int]] = []
    launch.progress.stage("warming up")
    for name, of_cell in groupby(launch.sessions, lambda session: session.cell.name):
        sessions = list(of_cell)
        learnt, dims = warm_up(control.setting, launch, sessions, blocks)
        latencies = LatencyDraw(Source(f"{name}, {config.latency}" if config.latency else name), learnt[:0], learnt)
        tried += [(cell, sessions, dims) for cell in cells(control, rules, latencies)]
    calibrations = {cell.latencies.source.name: asdict(cell.calibration) for cell, *_ in tried if cell.calibration}
    launch.writer.update(calibrations=calibrations)
    launch.warnings.extend(exchange_warnings(calibrations, FOLLOW))
    launch.progress.expect(len(tried))
    for cell, sessions, dims in Random(control.seed).sample(tried, len(tried)):  # noqa: S311 - an order, not a secret
        launch.progress.stage(f"acting for {config.seconds:g} s: {cell.cell}")
        setting = control.setting.slowed(cell.slower)
        robot = kind.open_actions(dims, setting.period_ns) if kind else None
        with nullcontext() if robot is None else closing(robot):
            launch.writer.update(robot={} if robot is None else robot.describe())
            ticks = max(2, round(config.seconds * 1e9 / setting.period_ns))
            acting, requester = act(cell.acting, setting, sessions, launch, blocks, ticks=ticks, robot=robot)
            live = LiveResult(cell, setting, acting.acted(), requester, tuple(acting.stepper.triggers))
            acted = live.actions()
            keep_origin(launch.writer, cell.cell, sessions[0].origin)
            whole = acted.ticks.chunk.size  # what is measured is kept
            for table, rows in cell_rows(acted, whole, rules.epsilon, control.seed).items():
                launch.writer.append(table, rows)
        if cell.rule in PROMISING and (changed := changes(control.setting, cell.cell, acted.cell.latencies)):
            launch.warnings.extend(changed)
            if cell.calibration:
                launch.writer.update(calibrations={cell.latencies.source.name: {"changed": True}})
        launch.progress.advance()
