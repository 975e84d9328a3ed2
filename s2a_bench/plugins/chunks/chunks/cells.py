"""The cells: each mode as given, and the first mode with a trigger once more under each rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from s2a_bench.harness.warnings import change_warnings
from s2a_bench.plugins.chunks.chunks.config import CYCLES, ChunksConfig
from s2a_bench.plugins.chunks.modes.trigger import (
    Learning,
    Maximum,
    Mean,
    TrackedLatency,
    TriggerRule,
    calibrate,
    follow,
    trigger,
)
from s2a_bench.policy.parameters import canonical
from s2a_bench.stats.seeds import generator

if TYPE_CHECKING:
    from s2a_bench.plugins.chunks.latencies import Source
    from s2a_bench.plugins.chunks.modes import Ints, Mode
    from s2a_bench.policy.conformal import Calibration
    from s2a_bench.store.manifest import RunWarning

FIXED: Final = ("calibrated", "oracle")
"""Rules that choose one trigger for all requests, and may slow actions down."""
GIVEN: Final = "given"
FOLLOW: Final = "take --rules tracked, whose trigger follows the delays"
_ORACLE_DRAWS: Final = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class LatencyDraw:
    """The latencies of one source in ns: those that are judged, and those that rules learn from."""

    source: Source
    judged: Ints
    learnt: Ints


@dataclass(frozen=True, slots=True, eq=False)
class ChunkCell:
    """One mode under one source; ``triggers`` are a rule's, one a request."""

    mode: Mode
    name: str
    """The mode with its parameters, without the trigger if a rule chooses it."""
    rule: str
    drawn: LatencyDraw
    triggers: tuple[int, ...] = ()
    slower: float = 1.0
    """By how many times slower its actions are executed (time-scaling)."""
    begin: Callable[[], TriggerRule] | None = None
    """Creates the rule that chooses triggers in a live run."""
    calibration: Calibration | None = None
    """What the rule `calibrated` learned."""

    @property
    def acting(self) -> Mode:
        if self.begin is not None:
            return Learning(self.mode, self.begin)
        return self.mode.varied(self.triggers) if self.triggers else self.mode

    @property
    def cell(self) -> str:
        rule = "" if self.rule == GIVEN else f", {self.rule}"
        return f"{self.name}{rule} @ {self.drawn.source.name}"


def draw(config: ChunksConfig, source: Source) -> LatencyDraw:
    """Draw the latencies of a source; a recording keeps its order, its first half for the rules if any."""
    count = config.learnt(source)
    if source.recorded_ns is not None:
        judged = source.recorded_ns[count:]
        return LatencyDraw(source, judged[: config.cycles], source.recorded_ns[:count])
    judged = source.draw(generator(config.seed, "chunks", source.name), config.cycles or CYCLES)
    return LatencyDraw(source, judged, source.draw(generator(config.seed, "chunks rules", source.name), count))


def cells(config: ChunksConfig, drawn: LatencyDraw) -> Iterator[ChunkCell]:
    """Yield the cells of one source; a live one has no judged latencies yet."""
    for name, given in config.control.modes.items():
        yield ChunkCell(given, name, GIVEN, drawn)
    mode = config.triggered
    if mode is None:
        return
    name = without_trigger(mode)
    for rule in config.rules_tried:
        most = max(1, mode.execution_horizon(config.setting) - 1)
        if rule in FIXED:
            known = calibrate(drawn.learnt, config.epsilon, config.guarantee) if rule == "calibrated" else None
            chosen = trigger(known.caution if known else _oracle_ns(config, drawn), config.setting, most)
            slower = min(chosen.beta, config.slowest)
            yield ChunkCell(mode, name, rule, drawn, (chosen.ticks,), slower, calibration=known)
        elif config.live:
            yield ChunkCell(mode, name, rule, drawn, begin=partial(_learner, config, rule, drawn))
        else:
            triggers = tuple(follow(_learner(config, rule, drawn), drawn.judged, config.setting, most).tolist())
            yield ChunkCell(mode, name, rule, drawn, triggers)


def changes(config: ChunksConfig, name: str, learnt: Ints, judged: Ints) -> list[RunWarning]:
    """Return whether the delays of ``judged`` latencies, in ticks, differ from those that a rule learned from."""
    learned, seen = (list(config.setting.delay_ticks(each).astype(float)[:, None]) for each in (learnt, judged))
    return change_warnings(name, learned, seen, "control ticks", f"calibrate anew, or {FOLLOW}")


def without_trigger(mode: Mode) -> str:
    return canonical(mode.name, mode.varied((0,)))


def _learner(config: ChunksConfig, rule: str, drawn: LatencyDraw) -> TriggerRule:
    if rule == "tracked":
        return TrackedLatency.begin(drawn.learnt.tolist(), config.epsilon)
    learner: TriggerRule = Maximum() if rule == "maximum" else Mean()
    for latency_ns in drawn.learnt.tolist():
        learner.learn(latency_ns, stalled=False)
    return learner


def _oracle_ns(config: ChunksConfig, drawn: LatencyDraw) -> int:
    """Return the latency that at most a share epsilon exceeds of a million other draws, or of the whole recording."""
    source = drawn.source
    latency_ns = source.recorded_ns
    if latency_ns is None:
        latency_ns = source.draw(generator(config.seed, "chunks oracle", source.name), _ORACLE_DRAWS)
    return int(np.sort(latency_ns)[-1 - int(config.epsilon * latency_ns.size)])
