"""What is tried: each mode as it is given, and the first queue again with its trigger chosen by each rule."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

from s2a_bench.experiments.chunks.closed import execution_horizon
from s2a_bench.experiments.study.worlds import generator
from s2a_bench.policy.chunks.append import Queue
from s2a_bench.policy.chunks.learning import Learning
from s2a_bench.policy.chunks.trigger import Maximum, Mean, Rule, Tracked, calibrate, follow, trigger
from s2a_bench.policy.chunks.varied import Varied

if TYPE_CHECKING:
    from s2a_bench.experiments.chunks.config import ChunksConfig
    from s2a_bench.experiments.chunks.latencies import Source
    from s2a_bench.policy.chunks import Ints, Mode

FIXED: Final = ("calibrated", "oracle")
"""The rules that choose one trigger for all requests, and may slow actions down."""
GIVEN: Final = "given"
"""The rule of a mode that is tried as it was asked for."""
_ORACLE_DRAWS: Final = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """The latencies of one source, in ns: those that are judged, and others that rules learn from."""

    source: Source
    judged: Ints
    learnt: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One mode under one source; ``triggers`` are those that a rule chose request by request."""

    mode: Mode
    name: str
    """The mode with its parameters; of one with a rule without the trigger."""
    rule: str
    drawn: Drawn
    triggers: tuple[int, ...] = ()
    slower: float = 1.0
    """So many times slower than the others it executes its actions (time-scaling)."""

    @property
    def cell(self) -> str:
        """Return its name."""
        rule = "" if self.rule == GIVEN else f", {self.rule}"
        return f"{self.name}{rule} @ {self.drawn.source.name}"


def draw(config: ChunksConfig, source: Source) -> Drawn:
    """Draw the latencies of a source; a recording is played in its order, its first half for the rules if any."""
    if source.recorded_ns is not None:
        count = min(config.calibration_cycles, source.recorded_ns.size // 2) if config.with_rules else 0
        judged = source.recorded_ns[count:]
        return Drawn(source, judged[: config.cycles], source.recorded_ns[:count])
    from s2a_bench.experiments.chunks.config import CYCLES

    judged = source.draw(generator(config.seed, "chunks", source.name), config.cycles or CYCLES)
    count = config.calibration_cycles if config.with_rules else 0
    return Drawn(source, judged, source.draw(generator(config.seed, "chunks rules", source.name), count))


def cells(config: ChunksConfig, drawn: Drawn) -> Iterator[Cell]:
    """Yield the cells of one source; live, nothing has been judged yet."""
    for name, mode in config.made.items():
        yield Cell(mode, name, GIVEN, drawn)
    queue = next((mode for mode in config.made.values() if isinstance(mode, Queue)), None)
    if queue is None:
        return
    name = f"queue?execute={queue.execute}" if queue.execute else "queue"
    for rule in config.rules_tried:
        most = max(1, execution_horizon(queue, config.setting) - 1)
        if rule in FIXED:
            ready_ns = (
                calibrate(drawn.learnt, config.epsilon).caution if rule == "calibrated" else _oracle_ns(config, drawn)
            )
            chosen = trigger(ready_ns, config.setting, most)
            mode = replace(queue, trigger=chosen.ticks)
            yield Cell(mode, name, rule, drawn, (chosen.ticks,), min(chosen.beta, config.slowest))
        elif config.live:
            yield Cell(Learning(partial(_made, config, rule, drawn), queue.execute), name, rule, drawn)
        else:
            triggers = follow(_made(config, rule, drawn), drawn.judged, config.setting, most).trigger.tolist()
            yield Cell(Varied(tuple(triggers), queue.execute), name, rule, drawn, tuple(triggers))


def _made(config: ChunksConfig, rule: str, drawn: Drawn) -> Rule:
    """Return a rule that has seen what the calibration has."""
    if rule == "tracked":
        return Tracked.begin(drawn.learnt.tolist(), config.epsilon)
    made: Rule = Maximum() if rule == "maximum" else Mean()
    for latency_ns in drawn.learnt.tolist():
        made.learn(latency_ns, stalled=False)
    return made


def _oracle_ns(config: ChunksConfig, drawn: Drawn) -> int:
    """Return the latency that a share epsilon of the distribution itself exceeds at most.

    The distribution is a million other draws; of a recording all that was recorded.
    """
    import numpy as np

    source = drawn.source
    latency_ns = source.recorded_ns
    if latency_ns is None:
        latency_ns = source.draw(generator(config.seed, "chunks oracle", source.name), _ORACLE_DRAWS)
    return int(np.sort(latency_ns)[-1 - int(config.epsilon * latency_ns.size)])
